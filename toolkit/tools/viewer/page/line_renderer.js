// Draws the camera path, the frusta of the keyframes and the loops, over the Gaussians.

const LOOP_RGB = [1.0, 0.36, 0.32];
const FRUSTUM_RGB = [0.36, 0.62, 1.0];
const CHOSEN_RGB = [1.0, 0.8, 0.2];
const LINE_PIXELS = { path: 2.2, keyframes: 1.1, loops: 2.6, object: 3 };
// Corners of a box that differ in one bit are connected.
const BOX_EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

class LineRenderer {
  constructor(gl) {
    this.gl = gl;
    Object.assign(this, buildProgram(gl, LINE_VERTEX, LINE_FRAGMENT));
    this.shown = { path: true, keyframes: true, loops: true, object: true };
    this.groups = {};
  }

  /** Show the lines of a scene, with the frustum of one keyframe (or null) highlighted. */
  show(scene, keyframe) {
    this.scene = scene;
    this.setGroup("path", pathSegments(scene));
    this.setGroup("loops", loopSegments(scene.loops));
    this.choose(keyframe);
  }

  /** Highlight the frustum of a keyframe; none for null. */
  choose(keyframe) { this.setGroup("keyframes", frustumSegments(this.scene, keyframe)); }

  /** Draw the box of an object of the scene graph; none for null. */
  chooseObject(object) {
    const corner = (i) => object.corners.slice(3 * i, 3 * i + 3);
    this.setGroup("object",
      object ? BOX_EDGES.map(([a, b]) => [...corner(a), ...corner(b), ...CHOSEN_RGB, 1]) : []);
  }

  /** Upload segments: 10 numbers each, both ends and the colour. */
  setGroup(name, segments) {
    const { gl } = this;
    const before = this.groups[name];
    if (before) {
      gl.deleteVertexArray(before.array);
      for (const buffer of before.buffers) gl.deleteBuffer(buffer);
    }
    const { array, corners } = quadArray(gl);
    const ends = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, ends);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(segments.flat()), gl.STATIC_DRAW);
    [[1, 3, 0], [2, 3, 12], [3, 4, 24]].forEach(([location, size, offset]) => {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, size, gl.FLOAT, false, 40, offset);
      gl.vertexAttribDivisor(location, 1);
    });
    gl.bindVertexArray(null);
    this.groups[name] = { array, buffers: [corners, ends], count: segments.length };
  }

  draw(camera, pixelRatio) {
    const { gl, uniforms } = this;
    gl.useProgram(this.program);
    setView(gl, uniforms, camera);
    for (const [name, { array, count }] of Object.entries(this.groups)) {
      if (!this.shown[name] || !count) continue;
      gl.uniform1f(uniforms.halfWidth, (LINE_PIXELS[name] * pixelRatio) / 2);
      gl.bindVertexArray(array);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    }
    gl.bindVertexArray(null);
  }
}

/** Lines between neighbouring poses; doubtful and interrupted ones have colours of their own. */
function pathSegments({ path, pathColours }) {
  const segments = [];
  for (let i = 0; i + 5 < path.length; i += 3) {
    const rgb = Array.from(pathColours.subarray(i, i + 3), (value) => value / 255);
    segments.push([...path.subarray(i, i + 6), ...rgb, 0.9]);
  }
  return segments;
}

function loopSegments(loops) {
  return loops.map(({ ends }) => [...ends, ...LOOP_RGB, 0.95]);
}

/** Length of the frusta in metres: small beside the room. */
function frustumDepth(scene) {
  return clamp(0.009 * norm(scene.box.extent), 0.03, 0.3);
}

function frustumSegments(scene, chosen) {
  const { camera, keyframes } = scene;
  if (!camera) return [];
  const segments = [];
  keyframes.forEach((keyframe) => {
    const depth = frustumDepth(scene) * (keyframe === chosen ? 1.6 : 1);
    const rgb = keyframe === chosen ? CHOSEN_RGB : FRUSTUM_RGB;
    const corners = [[-0.5, -0.5], [1, 0], [1, 1], [0, 1]].map(([u, v], i) => {
      const x = i === 1 || i === 2 ? camera.width - 0.5 : -0.5;
      const y = i >= 2 ? camera.height - 0.5 : -0.5;
      return fromCamera(keyframe.pose,
        [(depth * (x - camera.cx)) / camera.fx, (depth * (y - camera.cy)) / camera.fy, depth]);
    });
    const centre = poseColumn(keyframe.pose, 3);
    corners.forEach((corner, i) => {
      segments.push([...centre, ...corner, ...rgb, 0.55]);
      segments.push([...corner, ...corners[(i + 1) % 4], ...rgb, 0.55]);
    });
  });
  return segments;
}
