// What lies under a pixel.

const FRUSTUM_PICK_PIXELS = 14;
// A Gaussian belongs to an object at most this far from its voxels, which are 5 cm large, or from its
// box if they are unknown; in metres.
const OBJECT_REACH_M = 0.1;

/**
 * The Gaussian at a pixel of the canvas: the one at which the light has lost half of its strength,
 * from near to far; null if the pixel shows background.
 */
function pickSplat(scene, camera, x, y) {
  const { rows: [right, down, forward], eye } = camera.view;
  const { focal } = camera;
  const u = (x - camera.width / 2) / focal, v = (y - camera.height / 2) / focal;
  const hits = [];
  for (const [first, end] of scene.parts) {
    for (let i = first; i < end; i++) {
      const p = [scene.means[3 * i] - eye[0], scene.means[3 * i + 1] - eye[1], scene.means[3 * i + 2] - eye[2]];
      const depth = dot(forward, p);
      if (depth < NEAR_M) continue;
      const dx = dot(right, p) / depth - u, dy = dot(down, p) / depth - v;
      const variance = (scene.sigmas[i] / depth) ** 2 + 0.3 / focal ** 2;
      const distance = (dx * dx + dy * dy) / variance;
      if (distance > 11) continue;
      const alpha = (scene.rgba[4 * i + 3] / 255) * Math.exp(-0.5 * distance);
      if (alpha >= 1 / 255) hits.push([depth, alpha, i]);
    }
  }
  hits.sort((a, b) => a[0] - b[0]);
  let light = 1;
  for (const [, alpha, i] of hits) {
    light *= 1 - alpha;
    if (light < 0.5) return i;
  }
  return null;
}

/**
 * The object of a Gaussian, or null: of those of its class or group, the one with the nearest voxel.
 * Where voxels are unknown, it is the one with the nearest box, and of several boxes around the
 * Gaussian the smallest one.
 */
function objectOf(scene, { classPath, position }) {
  let best = null, nearest = OBJECT_REACH_M, smallest = Infinity;
  for (const object of scene.objects) {
    // A box cannot tell what a Gaussian of an unknown class belongs to.
    if (classPath.length ? classPath.some((name, level) => object.path[level] !== name) : !object.voxels) continue;
    let { distance, volume } = besideBox(object.corners, position);
    if (object.voxels && distance <= OBJECT_REACH_M) distance = besidePoints(object.voxels, position);
    if (distance > nearest || (distance === nearest && volume >= smallest)) continue;
    [best, nearest, smallest] = [object, distance, volume];
  }
  return best;
}

/** Distance of a point from the nearest of some points. */
function besidePoints(points, [x, y, z]) {
  let square = Infinity;
  for (let i = 0; i < points.length; i += 3) {
    square = Math.min(square, (points[i] - x) ** 2 + (points[i + 1] - y) ** 2 + (points[i + 2] - z) ** 2);
  }
  return Math.sqrt(square);
}

/** Distance of a point from a box, 0 inside, and the volume of the box. */
function besideBox(corners, point) {
  const origin = corners.slice(0, 3);
  let closest = origin, volume = 1;
  for (const corner of [1, 2, 4]) {
    const edge = sub(corners.slice(3 * corner, 3 * corner + 3), origin);
    const along = dot(edge, sub(point, origin)) / Math.max(dot(edge, edge), 1e-12);
    closest = add(closest, scale(edge, clamp(along, 0, 1)));
    volume *= norm(edge);
  }
  const distance = norm(sub(point, closest));
  // 0 inside of a box is not exact.
  return { distance: distance < 1e-6 ? 0 : distance, volume };
}

/** The keyframe whose camera lies near a pixel and nearest to the viewer, or null. */
function pickKeyframe(scene, camera, x, y, pixelRatio) {
  const reach = FRUSTUM_PICK_PIXELS * pixelRatio;
  let best = null, nearest = Infinity;
  for (const keyframe of scene.keyframes) {
    // The middle of the frustum, which is larger on the screen than its tip.
    const middle = fromCamera(keyframe.pose, [0, 0, frustumDepth(scene) / 2]);
    const [px, py, depth] = camera.project(middle);
    const far = Math.hypot(px - x, py - y);
    if (depth > 2 * NEAR_M && far < reach && depth < nearest) [best, nearest] = [keyframe, depth];
  }
  return best;
}

/** What is known about a Gaussian. */
function describeSplat(scene, i) {
  const nodes = scene.levels.map((column) => column[i]).filter((node) => node !== NO_NODE);
  return {
    classPath: nodes.length ? scene.tree.nodes[nodes.at(-1)].path : [],
    confidence: scene.confidence ? scene.confidence[i] / 255 : null,
    submap: scene.submap ? scene.submap[i] : null,
    inferred: scene.inferred ? Boolean(scene.inferred[i]) : null,
    position: [0, 1, 2].map((axis) => scene.means[3 * i + axis]),
  };
}
