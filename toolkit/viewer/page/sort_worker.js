// Sorts the Gaussians in view from far to near, outside the thread of the page.
"use strict";

const BUCKETS = 65536;
let means, sigmas, keys, counts;

/** Indices of the visible Gaussians, farthest first (counting sort by depth). */
function sorted({ rows, eye, slopeX, slopeY, near }) {
  const total = sigmas.length;
  const [right, down, forward] = rows;
  let lowest = Infinity, highest = -Infinity, visible = 0;
  const depths = keys.depths, chosen = keys.chosen;
  for (let i = 0; i < total; i++) {
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
  const perDepth = (BUCKETS - 1) / Math.max(highest - lowest, 1e-6);
  const buckets = keys.buckets;
  counts.fill(0);
  for (let i = 0; i < visible; i++) {
    buckets[i] = (highest - depths[i]) * perDepth;
    counts[buckets[i] + 1]++;
  }
  for (let i = 0; i < BUCKETS; i++) counts[i + 1] += counts[i];
  const order = new Uint32Array(visible);
  for (let i = 0; i < visible; i++) order[counts[buckets[i]]++] = chosen[i];
  return order;
}

onmessage = ({ data }) => {
  if (data.means) {
    ({ means, sigmas } = data);
    const total = sigmas.length;
    counts = new Uint32Array(BUCKETS + 1);
    keys = {
      depths: new Float32Array(total), chosen: new Uint32Array(total), buckets: new Uint16Array(total),
    };
    return;
  }
  const order = sorted(data);
  postMessage({ order, serial: data.serial }, [order.buffer]);
};
