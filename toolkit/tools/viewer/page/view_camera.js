// The camera of the page: it orbits around a target and stays upright. As in the map, its axes are
// x right, y down, z forward.

const FOV_Y_RAD = (55 * Math.PI) / 180;
const NEAR_M = 0.05;
const MAX_PITCH_RAD = 1.55;

class ViewCamera {
  /** Start from a scene; `up` is its vertical. */
  constructor(scene) {
    this.width = this.height = 1;
    this.setVertical(scene);
    this.reset(scene);
  }

  setVertical(scene) {
    this.up = unit(scene.up);
    this.ahead = horizontal(this.up, scene.keyframes[0]);
    this.right0 = unit(cross(this.ahead, this.up));
  }

  /** Keep the view in another state of the scene, whose vertical may have been corrected. */
  adopt(scene) {
    const { forward, eye } = this;
    this.setVertical(scene);
    this.setDirection(forward);
    this.target = add(eye, scale(this.forward, this.distance));
  }

  reset(scene) {
    if (scene.keyframes.length) this.setPose(scene.keyframes[0].pose);
    else this.showAll(scene);
  }

  /** Look at the whole map from outside and above. */
  showAll(scene) {
    const { low, extent } = scene.box;
    this.target = [0, 1, 2].map((axis) => low[axis] + extent[axis] / 2);
    this.distance = Math.max(0.85 * norm(extent), 0.1);
    this.yaw = 0.5;
    this.pitch = -0.5;
  }

  /** Look as a camera of the run, without its roll. */
  setPose(pose) {
    this.distance = this.distance > 0.3 && this.distance < 5 ? this.distance : 2;
    this.setDirection(poseColumn(pose, 2));
    this.target = add(poseColumn(pose, 3), scale(this.forward, this.distance));
  }

  setDirection(forward) {
    this.pitch = clamp(Math.asin(clamp(dot(forward, this.up), -1, 1)), -MAX_PITCH_RAD, MAX_PITCH_RAD);
    this.yaw = Math.atan2(dot(forward, this.right0), dot(forward, this.ahead));
  }

  /** Look at a place, from at least a distance of it, without moving the eye farther than needed. */
  lookAt(place, distance) {
    const eye = this.eye;
    const away = norm(sub(place, eye));
    if (away > 1e-6) this.setDirection(scale(sub(place, eye), 1 / away));
    this.distance = Math.max(away, distance);
    this.target = place;
  }

  get forward() {
    const level = add(scale(this.ahead, Math.cos(this.yaw)), scale(this.right0, Math.sin(this.yaw)));
    return add(scale(level, Math.cos(this.pitch)), scale(this.up, Math.sin(this.pitch)));
  }

  get right() { return unit(cross(this.forward, this.up)); }

  get down() { return cross(this.forward, this.right); }

  get eye() { return sub(this.target, scale(this.forward, this.distance)); }

  /** Focal length in pixels of the canvas. */
  get focal() { return this.height / 2 / Math.tan(FOV_Y_RAD / 2); }

  /** Turn around the target, or around the eye (flying). */
  turn(yaw, pitch, aroundEye) {
    const eye = this.eye;
    this.yaw += yaw;
    this.pitch = clamp(this.pitch + pitch, -MAX_PITCH_RAD, MAX_PITCH_RAD);
    if (aroundEye) this.target = add(eye, scale(this.forward, this.distance));
  }

  /** Move camera and target, in metres along right, down and forward. */
  move(right, down, forward) {
    const shift = add(add(scale(this.right, right), scale(this.down, down)), scale(this.forward, forward));
    this.target = add(this.target, shift);
  }

  /** Approach the target by a factor. */
  zoom(factor) { this.distance = clamp(this.distance * factor, 0.05, 500); }

  /** Rotation (rows right, down, forward) and eye for shaders and sorting. */
  get view() {
    return { rows: [this.right, this.down, this.forward], eye: this.eye };
  }

  /** Pixel and depth of a point; the pixel is meaningless for depths <= 0. */
  project(point) {
    const { rows, eye } = this.view;
    const relative = sub(point, eye);
    const [x, y, z] = rows.map((row) => dot(row, relative));
    return [this.width / 2 + (this.focal * x) / z, this.height / 2 + (this.focal * y) / z, z];
  }
}

/** The horizontal direction of the first keyframe, or any. */
function horizontal(up, keyframe) {
  const candidates = [[0, 0, 1], [1, 0, 0], [0, 1, 0]];
  if (keyframe) candidates.unshift(poseColumn(keyframe.pose, 2));
  for (const candidate of candidates) {
    const level = sub(candidate, scale(up, dot(candidate, up)));
    if (norm(level) > 0.2) return unit(level);
  }
  return [0, 0, 1];
}
