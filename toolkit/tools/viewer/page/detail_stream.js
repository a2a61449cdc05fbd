// Levels of detail of a large map: which nodes of its octree are shown, and which are loaded.
//
// A node is replaced by its children when all of them are loaded, so that there are never holes.

// Places of Gaussians are allocated in blocks of this many, a divisor of a texture's row.
const BLOCK = 512;
// Space relative to the budget, for nodes that are not shown: those above the shown ones, and others
// for the way back.
const SPACE = 2;
// Cells of merged Gaussians may have this size on the screen; those out of view count less.
const ENOUGH_PIXELS = 1;
const OUT_OF_VIEW = 0.15;
const REQUESTS = 6;
const RETRY_MS = 1000;

const blocksFor = (count) => Math.ceil(count / BLOCK);

class DetailStream {
  /** `changed()` is called when more can be shown, `outdated()` if the server has another map. */
  constructor(scene, changed, outdated) {
    Object.assign(this, { scene, changed, outdated });
    const { nodeBoxes, nodeCells, nodeCounts, nodeChildren } = scene.nodes;
    Object.assign(this, { nodeBoxes, nodeCells, nodeCounts, nodeChildren });
    this.resident = new Map(); // node -> its blocks and when it was needed last
    this.requested = new Set();
    this.wanted = [0];
    this.needed = new Set([0]);
    this.refined = new Set();
    this.shown = [];
    this.round = 0;
    this.loadedBytes = 0;
    this.allocate();
  }

  /** Replace the columns of the scene, which are those of the root, by empty ones with more space. */
  allocate() {
    const { scene } = this;
    let all = 0;
    for (const count of this.nodeCounts) all += blocksFor(count);
    const needed = BLOCK * Math.min(all, blocksFor(SPACE * scene.stream.budget));
    scene.capacity = ROW * Math.ceil(needed / ROW);
    this.blocks = scene.capacity / BLOCK;
    this.free = Array.from({ length: this.blocks }, (_, i) => i * BLOCK).reverse();
    this.root = { ...scene };
    for (const [name, width] of Object.entries(columnWidths(scene))) {
      // Shapes and harmonics are kept by the graphics processor only.
      if (scene[name] && name !== "shapes" && name !== "harmonics") {
        scene[name] = new scene[name].constructor(width * scene.capacity);
      }
    }
    scene.levels = scene.levels.map(() => new Uint16Array(scene.capacity));
    scene.parts = [];
  }

  /** Show the root, whose columns came with the page. */
  start(renderer, colouring) {
    Object.assign(this, { renderer, colouring });
    this.store(0, this.root);
    this.root = null;
    this.update();
  }

  /**
   * Choose the nodes for a view, and load what is missing. At most `drawn` Gaussians are in view,
   * and at most the budget of the map in all.
   */
  choose(camera, drawn) {
    const { nodeChildren, nodeCounts } = this;
    const { budget } = this.scene.stream;
    const view = viewOf(camera);
    const queue = new NodeQueue();
    const add = (node) => this.wanted.push(node) && queue.push(node, this.pixels(node, view));
    this.round++;
    this.wanted = [];
    this.refined.clear();
    this.limited = false; // by `drawn`
    let total = nodeCounts[0], inView = nodeCounts[0], blocks = blocksFor(nodeCounts[0]);
    add(0);
    while (queue.size) {
      const [node, pixels] = queue.pop();
      if (pixels < ENOUGH_PIXELS) break;
      const first = nodeChildren[2 * node], end = first + nodeChildren[2 * node + 1];
      if (first === end) continue;
      let more = -nodeCounts[node], moreInView = this.inView(node, view) ? more : 0, moreBlocks = 0;
      for (let child = first; child < end; child++) {
        more += nodeCounts[child];
        moreBlocks += blocksFor(nodeCounts[child]);
        if (this.inView(child, view)) moreInView += nodeCounts[child];
      }
      if (total + more > budget || blocks + moreBlocks > this.blocks) continue;
      if (inView + moreInView > drawn) {
        this.limited = true;
        continue;
      }
      total += more;
      blocks += moreBlocks;
      inView += moreInView;
      this.refined.add(node);
      for (let child = first; child < end; child++) add(child);
    }
    this.needed = new Set(this.wanted);
    for (const node of this.wanted) {
      const entry = this.resident.get(node);
      if (entry) entry.round = this.round;
    }
    this.load();
    return this.update();
  }

  /** Size in pixels of the cells of a node where it is nearest; less for nodes out of view. */
  pixels(node, view) {
    let square = 0;
    for (let axis = 0; axis < 3; axis++) {
      const low = this.nodeBoxes[6 * node + axis], high = this.nodeBoxes[6 * node + 3 + axis];
      square += Math.max(low - view.eye[axis], view.eye[axis] - high, 0) ** 2;
    }
    const pixels = (this.nodeCells[node] * view.focal) / Math.max(Math.sqrt(square), NEAR_M);
    return this.inView(node, view) ? pixels : OUT_OF_VIEW * pixels;
  }

  /** Whether the ball around the box of a node may be in view. */
  inView(node, { eye, rows: [right, down, forward], slopeX, slopeY }) {
    const low = this.nodeBoxes.subarray(6 * node, 6 * node + 3);
    const high = this.nodeBoxes.subarray(6 * node + 3, 6 * node + 6);
    const middle = sub(scale(add(low, high), 0.5), eye);
    const radius = norm(sub(high, low)) / 2;
    const depth = dot(forward, middle);
    return depth > -radius
      && Math.abs(dot(right, middle)) < slopeX * depth + radius * Math.hypot(1, slopeX)
      && Math.abs(dot(down, middle)) < slopeY * depth + radius * Math.hypot(1, slopeY);
  }

  /** Whether all that the view needs is loaded. */
  get complete() { return this.wanted.every((node) => this.resident.has(node)); }

  /** Show the finest nodes that are loaded completely; returns whether that is a change. */
  update() {
    const shown = [];
    const visit = (node) => {
      const first = this.nodeChildren[2 * node], end = first + this.nodeChildren[2 * node + 1];
      let ready = this.refined.has(node);
      for (let child = first; ready && child < end; child++) ready = this.resident.has(child);
      if (!ready) shown.push(node);
      else for (let child = first; child < end; child++) visit(child);
    };
    visit(0);
    if (shown.length === this.shown.length && shown.every((node, i) => node === this.shown[i])) return false;
    // The renderer draws the parts before until the next order arrives.
    for (const node of this.shown) this.resident.get(node).lastCut = this.renderer.cut;
    this.shown = shown;
    for (const node of shown) this.resident.get(node).lastCut = Infinity;
    this.scene.parts = shown.flatMap((node) => this.resident.get(node).parts);
    this.renderer.partsChanged();
    return true;
  }

  /** Request missing nodes, the most important first. */
  load() {
    for (const node of this.wanted) {
      if (this.requested.size >= REQUESTS) return;
      if (this.resident.has(node) || this.requested.has(node)) continue;
      if (!this.makeSpace(this.nodeCounts[node])) return;
      this.requested.add(node);
      this.request(node);
    }
  }

  async request(node) {
    try {
      const answer = await fetch(`chunks/${this.scene.version}/${node}`);
      if (answer.status === 404) this.outdated();
      if (!answer.ok) throw new Error(`status ${answer.status}`);
      const buffer = await answer.arrayBuffer();
      this.loadedBytes += buffer.byteLength;
      if (!this.ended && this.needed.has(node) && this.makeSpace(this.nodeCounts[node])) {
        this.store(node, readChunk(buffer));
      }
    } catch {
      // The server was stopped, or the connection was lost: what is loaded remains visible.
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
    }
    this.requested.delete(node);
    if (this.ended) return;
    this.load();
    this.changed();
  }

  /** Another map is shown. */
  end() { this.ended = true; }

  /** Free enough places; false if all are in use. */
  makeSpace(count) {
    const blocks = blocksFor(count);
    if (this.free.length >= blocks) return true;
    const unused = [...this.resident].filter(([node, { lastCut }]) =>
      !this.needed.has(node) && lastCut < this.renderer.drawnCut);
    unused.sort(([, a], [, b]) => a.round - b.round);
    for (const [node, { blocks: used }] of unused) {
      this.free.push(...used);
      this.resident.delete(node);
      if (this.free.length >= blocks) return true;
    }
    return false;
  }

  /** Keep the Gaussians of a node, in places that need not follow each other. */
  store(node, columns) {
    const { scene, renderer } = this;
    const blocks = this.free.splice(this.free.length - blocksFor(columns.count)).reverse();
    const parts = [];
    const widths = Object.entries(columnWidths(scene));
    blocks.forEach((first, i) => {
      const begin = i * BLOCK, end = Math.min(begin + BLOCK, columns.count);
      for (const [name, width] of widths) {
        if (scene[name] && name !== "shapes" && name !== "harmonics") {
          scene[name].set(columns[name].subarray(width * begin, width * end), width * first);
        }
      }
      scene.levels.forEach((level, l) => level.set(columns.levels[l].subarray(begin, end), first));
      if (parts.length && parts.at(-1)[1] === first) parts.at(-1)[1] = first + end - begin;
      else parts.push([first, first + end - begin]);
    });
    let done = 0;
    for (const [first, end] of parts) {
      renderer.upload(columns, done, done + end - first, first);
      renderer.setColours(first, this.colouring.rgba(first, end));
      done += end - first;
    }
    this.resident.set(node, { blocks, parts, round: this.round, lastCut: -1 });
  }

  /** Colour all that is loaded anew. */
  recolour() {
    for (const { parts } of this.resident.values()) {
      for (const [first, end] of parts) this.renderer.setColours(first, this.colouring.rgba(first, end));
    }
  }
}

/** Numbers per Gaussian of the columns that a scene may have. */
function columnWidths(scene) {
  const degree = scene.harmonics ? scene.harmonics.length / scene.count : 0;
  return {
    means: 3, sigmas: 1, rgba: 4, shapes: 6, harmonics: degree, confidence: 1, submap: 1, inferred: 1,
  };
}

function viewOf(camera) {
  const { focal, width, height } = camera;
  return { ...camera.view, focal, slopeX: width / 2 / focal, slopeY: height / 2 / focal };
}

/** Nodes by their priority, the highest first (a binary heap). */
class NodeQueue {
  constructor() { this.items = []; }

  get size() { return this.items.length; }

  push(node, priority) {
    const { items } = this;
    let i = items.length;
    items.push([node, priority]);
    for (let above; i && items[above = (i - 1) >> 1][1] < priority; i = above) items[i] = items[above];
    items[i] = [node, priority];
  }

  pop() {
    const { items } = this;
    const top = items[0], last = items.pop();
    if (items.length) {
      let i = 0;
      for (let below; (below = 2 * i + 1) < items.length; i = below) {
        if (below + 1 < items.length && items[below + 1][1] > items[below][1]) below++;
        if (items[below][1] <= last[1]) break;
        items[i] = items[below];
      }
      items[i] = last;
    }
    return top;
  }
}
