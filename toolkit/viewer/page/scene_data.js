// Decodes the scene that is embedded in the page.

const NO_NODE = 65535;
const ARRAY_TYPES = {
  uint8: Uint8Array, uint16: Uint16Array, int16: Int16Array, int32: Int32Array,
  float32: Float32Array,
};

/** Read header and arrays; the text of the elements is freed. */
function readScene() {
  const scene = JSON.parse(takeText("scene"));
  const bytes = decodeBase64(takeText("data"));
  const arrays = {};
  for (const [name, { offset, length, type }] of Object.entries(scene.arrays)) {
    arrays[name] = new ARRAY_TYPES[type](bytes.buffer, offset, length);
  }
  scene.means = positions(scene, arrays.means);
  scene.sigmas = sigmas(scene, arrays.sigmas);
  scene.rgba = arrays.rgba;
  scene.shapes = arrays.shapes
    ? Float32Array.from(arrays.shapes, (value) => value * scene.shapeScale) : null;
  scene.levels = levels(scene, arrays.levels);
  scene.confidence = arrays.confidence ?? null;
  scene.submap = arrays.submap ?? null;
  scene.inferred = arrays.inferred ?? null;
  scene.path = arrays.path;
  scene.pathColours = arrays.pathColours;
  return scene;
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

function positions(scene, packed) {
  const means = new Float32Array(packed.length);
  for (let i = 0; i < packed.length; i++) {
    means[i] = scene.low[i % 3] + (packed[i] / 65535) * scene.extent[i % 3];
  }
  return means;
}

function sigmas(scene, packed) {
  const [smallest, span] = scene.logSigma;
  const table = Float32Array.from({ length: 256 }, (_, i) => Math.exp(smallest + (i / 255) * span));
  return Float32Array.from(packed, (value) => table[value]);
}

/** One array of node indices per level of the tree. */
function levels(scene, packed) {
  if (!packed || !scene.tree) return [];
  return scene.tree.levels.map((_, level) =>
    packed.subarray(level * scene.count, (level + 1) * scene.count));
}
