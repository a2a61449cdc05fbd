// Vectors as arrays of three numbers.

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
const norm = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => scale(a, 1 / Math.max(norm(a), 1e-12));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** Axis `column` (0 x, 1 y, 2 z) or position (3) of a pose of 12 numbers, row by row. */
const poseColumn = (pose, column) => [pose[column], pose[4 + column], pose[8 + column]];

/** A point in the frame of a camera, in the frame of the map. */
const fromCamera = (pose, point) => [0, 1, 2].map((row) =>
  pose[4 * row] * point[0] + pose[4 * row + 1] * point[1] + pose[4 * row + 2] * point[2]
  + pose[4 * row + 3]);
