// Decodes the scene that is embedded in the page, and the parts of large maps that follow.

const NO_NODE = 65535;
const ARRAY_TYPES = {
  int8: Int8Array, uint8: Uint8Array, uint16: Uint16Array, int16: Int16Array, int32: Int32Array,
  float32: Float32Array,
};

/** Read header and arrays; the text of the elements is freed. */
function readScene() {
  const scene = JSON.parse(takeText("scene"));
  const arrays = arraysOf(scene, decodeBase64(takeText("data")).buffer, 0);
  Object.assign(scene, decodeSplats(scene, arrays));
  scene.box = scene.overview ?? { low: scene.low, extent: scene.extent };
  scene.parts = [[0, scene.count]]; // ranges of the Gaussians that are shown
  scene.capacity = scene.count;
  scene.path = arrays.path;
  scene.pathColours = arrays.pathColours;
  scene.nodes = scene.stream ? arrays : null;
  return scene;
}

/** Read a part that the server sent: the length of the header, the header, and arrays. */
function readChunk(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return decodeSplats(header, arraysOf(header, buffer, 4 + length));
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
  const text = element.textContent;
  element.remove();
  return text;
}

function decodeBase64(text) {
  const clean = text.trim();
  const padding = clean.endsWith("==") ? 2 : clean.endsWith("=") ? 1 : 0;
  const bytes = new Uint8Array((clean.length / 4) * 3 - padding);
  const step = 1 << 20; // a multiple of 4, small enough for a string of its own
  let place = 0;
  for (let start = 0; start < clean.length; start += step) {
    const part = atob(clean.slice(start, start + step));
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
