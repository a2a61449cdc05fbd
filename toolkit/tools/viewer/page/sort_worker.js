// Sorts the Gaussians in view from far to near, outside the thread of the page.
"use strict";

const BUCKETS = 65536;
// In metres. Beyond, even steps of depth would be too coarse for what is near.
const EVEN_DEPTHS = 500;
let means, sigmas, keys;
let parts = []; // ranges of the Gaussians that are shown
const counts = new Uint32Array(BUCKETS + 1);

/** Indices of the visible Gaussians, farthest first (counting sort by depth). */
function sorted({ rows, eye, slopeX, slopeY, near }) {
  const [right, down, forward] = rows;
  let lowest = Infinity, highest = -Infinity, visible = 0;
  const depths = keys.depths, chosen = keys.chosen;
  for (const [first, end] of parts) {
    for (let i = first; i < end; i++) {
      const x = means[3 * i] - eye[0], y = means[3 * i + 1] - eye[1], z = means[3 * i + 2] - eye[2];
      const depth = forward[0] * x + forward[1] * y + forward[2] * z;
      if (depth < near) continue;
      const margin = 4 * sigmas[i];
      if (Math.abs(right[0] * x + right[1] * y + right[2] * z) > slopeX * depth + margin) continue;
      if (Math.abs(down[0] * x + down[1] * y + down[2] * z) > slopeY * depth + margin) continue;
      depths[visible] = depth;
      chosen[visible++] = i;
      if (depth < lowest) lowest = depth;
      if (depth > highest) highest = depth;
    }
  }
  if (highest > EVEN_DEPTHS) {
    for (let i = 0; i < visible; i++) depths[i] = Math.log(depths[i]);
    [lowest, highest] = [Math.log(lowest), Math.log(highest)];
  }
  const perDepth = (BUCKETS - 1) / Math.max(highest - lowest, 1e-6);
  const buckets = keys.buckets;
  counts.fill(0);
  for (let i = 0; i < visible; i++) {
    // Stored depths are rounded, and can lie a little beyond the highest one.
    buckets[i] = Math.max((highest - depths[i]) * perDepth, 0);
    counts[buckets[i] + 1]++;
  }
  for (let i = 0; i < BUCKETS; i++) counts[i + 1] += counts[i];
  const order = new Uint32Array(visible);
  for (let i = 0; i < visible; i++) order[counts[buckets[i]]++] = chosen[i];
  return order;
}

/** Forget all Gaussians, and make space for this many. */
function allocate(capacity) {
  means = new Float32Array(3 * capacity);
  sigmas = new Float32Array(capacity);
  keys = {
    depths: new Float32Array(capacity), chosen: new Uint32Array(capacity),
    buckets: new Uint16Array(capacity),
  };
}

onmessage = ({ data }) => {
  if (data.capacity !== undefined) allocate(data.capacity);
  else if (data.parts) parts = data.parts;
  else if (data.means) {
    means.set(data.means, 3 * data.first);
    sigmas.set(data.sigmas, data.first);
  } else {
    const order = sorted(data);
    postMessage({ order, serial: data.serial, cut: data.cut }, [order.buffer]);
  }
};
