// Decodes the scene, which the page contains or a server sends, and the parts of large maps that follow.

const NO_NODE = 65535;
const ARRAY_TYPES = {
  int8: Int8Array, uint8: Uint8Array, uint16: Uint16Array, int16: Int16Array, int32: Int32Array,
  float32: Float32Array,
};

/** The scene in the page, whose text is freed; null if a server sends it. */
function embeddedScene() {
  const header = takeText("scene"), data = takeText("data");
  return header ? sceneOf(JSON.parse(header), decodeBase64(data).buffer, 0) : null;
}

/** A scene that the server sent. */
function readScene(buffer) {
  const { header, start } = readHeader(buffer);
  return sceneOf(header, buffer, start);
}

/** The Gaussians of a part that the server sent. */
function readChunk(buffer) {
  const { header, start } = readHeader(buffer);
  return decodeSplats(header, arraysOf(header, buffer, start));
}

/** What the server sends: the length of the header, the header, and arrays. */
function readHeader(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { header, start: 4 + length };
}

/** A scene from its header and its arrays, which begin at a place of the buffer. */
function sceneOf(scene, buffer, start) {
  const arrays = arraysOf(scene, buffer, start);
  Object.assign(scene, decodeSplats(scene, arrays));
  scene.box = scene.overview;
  scene.parts = [[0, scene.count]]; // ranges of the Gaussians that are shown
  scene.capacity = scene.count;
  scene.path = arrays.path;
  scene.pathColours = arrays.pathColours;
  scene.nodes = scene.stream ? arrays : null;
  let place = 0;
  for (const object of scene.objects) {
    // Null if only the box of the object is known.
    if (object.voxels !== null) object.voxels = arrays.voxels.subarray(place, place += 3 * object.voxels);
  }
  return scene;
}

function arraysOf(header, buffer, start) {
  const arrays = {};
  for (const [name, { offset, length, type }] of Object.entries(header.arrays)) {
    arrays[name] = new ARRAY_TYPES[type](buffer, start + offset, length);
  }
  return arrays;
}

/** The columns of Gaussians; those that a map does not have are null or empty. */
function decodeSplats(header, arrays) {
  return {
    count: header.count,
    means: positions(header, arrays.means),
    sigmas: sigmas(header, arrays.sigmas),
    rgba: arrays.rgba,
    shapes: arrays.shapes
      ? Float32Array.from(arrays.shapes, (value) => value * header.shapeScale) : null,
    harmonics: arrays.harmonics ?? null,
    levels: levels(header, arrays.levels),
    confidence: arrays.confidence ?? null,
    submap: arrays.submap ?? null,
    inferred: arrays.inferred ?? null,
  };
}

function takeText(id) {
  const element = document.getElementById(id);
  const text = element.textContent.trim();
  element.remove();
  return text;
}

function decodeBase64(text) {
  const padding = text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0;
  const bytes = new Uint8Array((text.length / 4) * 3 - padding);
  const step = 1 << 20; // a multiple of 4, small enough for a string of its own
  let place = 0;
  for (let start = 0; start < text.length; start += step) {
    const part = atob(text.slice(start, start + step));
    for (let i = 0; i < part.length; i++) bytes[place++] = part.charCodeAt(i);
  }
  return bytes;
}

function positions(header, packed) {
  if (packed instanceof Float32Array) return packed;
  const means = new Float32Array(packed.length);
  for (let i = 0; i < packed.length; i++) {
    means[i] = header.low[i % 3] + (packed[i] / 65535) * header.extent[i % 3];
  }
  return means;
}

function sigmas(header, packed) {
  const [smallest, span] = header.logSigma;
  const table = Float32Array.from({ length: 256 }, (_, i) => Math.exp(smallest + (i / 255) * span));
  return Float32Array.from(packed, (value) => table[value]);
}

/** One array of node indices per level of the tree. */
function levels(header, packed) {
  if (!packed) return [];
  return Array.from({ length: packed.length / header.count }, (_, level) =>
    packed.subarray(level * header.count, (level + 1) * header.count));
}
