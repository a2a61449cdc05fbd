// Colours of the Gaussians: as observed, by class at a level of the tree, by submap, by confidence,
// or by the source of their position.

// Opacity and brightness of Gaussians that are not highlighted.
const DIMMED_OPACITY = 0.07;
const DIMMED_BRIGHTNESS = 0.6;
const CONFIDENCE_STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

/** The kinds of colours that a scene has. */
function colourModes(scene) {
  const modes = [["colour", "Colour"]];
  if (scene.levels.length) modes.push(["classes", "Classes"]);
  const submaps = scene.tallies ? scene.tallies.submaps.length : new Set(scene.submap).size;
  if (scene.submap && submaps > 1) modes.push(["submaps", "Submaps"]);
  if (scene.confidence) modes.push(["confidence", "Confidence"]);
  if (scene.inferred) modes.push(["source", "Source"]);
  return modes;
}

class Colouring {
  constructor(scene) {
    this.scene = scene;
    this.mode = "colour";
    this.level = Math.max(scene.levels.length - 1, 0);
    this.highlighted = null; // { matches(i), keys }
  }

  /** Keep what is chosen in another state of the scene, as far as that has it. */
  adopt(scene) {
    const before = this.scene;
    this.scene = scene;
    if (before.levels.length !== scene.levels.length) this.level = Math.max(scene.levels.length - 1, 0);
    const known = colourModes(scene).some(([mode]) => mode === this.mode);
    if (!known) this.mode = "colour";
    const keys = known && this.highlighted ? [...this.highlighted.keys] : [];
    this.highlightKeys(new Set(this.mode === "classes" ? this.renumbered(before.tree, keys) : keys));
  }

  /** The nodes of another tree in the tree of the scene. */
  renumbered(tree, nodes) {
    const nameOf = ({ path }) => JSON.stringify(path);
    const numbers = new Map(this.scene.tree.nodes.map((node, number) => [nameOf(node), number]));
    const all = nodes.map((node) => (node === NO_NODE ? node : numbers.get(nameOf(tree.nodes[node]))));
    return all.filter((node) => node !== undefined);
  }

  /** Value of a Gaussian in the legend: node, submap, or source; null in other modes. */
  keyOf(i) {
    const { scene } = this;
    if (this.mode === "classes") return scene.levels[this.level][i];
    if (this.mode === "submaps") return scene.submap[i];
    if (this.mode === "source") return scene.inferred[i];
    return null;
  }

  colourOf(key) {
    const { palette, tree } = this.scene;
    if (this.mode === "classes") return key === NO_NODE ? palette.unknown : tree.nodes[key].rgb;
    if (this.mode === "submaps") return submapColour(key);
    return key ? palette.inferred : palette.measured;
  }

  nameOf(key) {
    if (this.mode === "classes") {
      return key === NO_NODE ? "no class" : this.scene.tree.nodes[key].path.at(-1);
    }
    if (this.mode === "submaps") return `submap ${key}`;
    return key ? "inferred (depth prior)" : "measured";
  }

  /** Numbers of Gaussians by their value in the legend; of a streamed map, of all of it. */
  counts() {
    const { count, tallies } = this.scene;
    const counts = new Map();
    const addTo = (key, number) => counts.set(key, (counts.get(key) ?? 0) + number);
    if (!tallies) for (let i = 0; i < count; i++) addTo(this.keyOf(i), 1);
    else if (this.mode === "classes") {
      for (const [nodes, number] of tallies.classes) addTo(nodes[this.level], number);
    } else for (const [key, number] of tallies[this.mode]) addTo(key, number);
    return counts;
  }

  /** Entries of the legend, most frequent first. */
  legend() {
    const { total, count, tallies } = this.scene;
    if (!["classes", "submaps", "source"].includes(this.mode)) return [];
    const entries = [...this.counts()].map(([key, number]) => ({
      key, name: this.nameOf(key), rgb: this.colourOf(key), fraction: number / (tallies ? total : count),
    }));
    if (this.mode === "submaps") return entries.sort((a, b) => a.key - b.key);
    return entries.sort((a, b) => (a.key === NO_NODE) - (b.key === NO_NODE) || b.fraction - a.fraction);
  }

  /** Whether colours are those that were observed, to which harmonics can be added. */
  get observed() { return this.mode === "colour" && !this.highlighted; }

  /** Colours of the Gaussians `first` to `end`, four bytes each. */
  rgba(first, end) {
    const { scene, highlighted } = this;
    if (this.observed) return scene.rgba.subarray(4 * first, 4 * end);
    const result = new Uint8Array(4 * (end - first));
    const known = new Map();
    for (let i = first; i < end; i++) {
      const observed = scene.rgba.subarray(4 * i, 4 * i + 4);
      let rgb = observed;
      if (this.mode === "confidence") rgb = confidenceColour(scene.confidence[i]);
      else if (this.mode !== "colour") {
        const key = this.keyOf(i);
        if (!known.has(key)) known.set(key, this.colourOf(key));
        rgb = known.get(key);
      }
      const light = brightness(observed) / 255;
      // Some of the observed brightness remains, or objects of one class have no visible shape.
      let shade = this.mode === "colour" ? 1 : 0.65 + 0.45 * light;
      let opacity = 1;
      const match = !highlighted || highlighted.matches(i);
      if (match && highlighted?.rgb) rgb = highlighted.rgb(i);
      if (!match) {
        const grey = 255 * light;
        rgb = [grey, grey, grey];
        shade = DIMMED_BRIGHTNESS;
        opacity = DIMMED_OPACITY;
      }
      const place = 4 * (i - first);
      for (let c = 0; c < 3; c++) result[place + c] = Math.min(shade * rgb[c], 255);
      result[place + 3] = opacity * observed[3];
    }
    return result;
  }

  /** Highlight Gaussians whose legend entry is one of these keys. */
  highlightKeys(keys) {
    this.highlighted = keys.size ? { keys, matches: (i) => keys.has(this.keyOf(i)) } : null;
  }

  /** Highlight the classes and groups whose name contains a text; returns their nodes. */
  highlightText(text) {
    const nodes = matchingNodes(this.scene.tree, text);
    this.highlighted = null;
    if (!nodes.length) return nodes;
    const byLevel = this.scene.levels.map((_, level) =>
      new Set(nodes.filter((node) => this.scene.tree.nodes[node].level === level)));
    this.highlighted = {
      keys: new Set(byLevel[this.level]),
      matches: (i) => byLevel.some((set, level) => set.has(this.scene.levels[level][i])),
      matchesNodes: (path) => byLevel.some((set, level) => set.has(path[level])),
      rgb: (i) => {
        const level = byLevel.findIndex((set, l) => set.has(this.scene.levels[l][i]));
        return this.scene.tree.nodes[this.scene.levels[level][i]].rgb;
      },
    };
    return nodes;
  }

  /** Number of Gaussians that the text highlights; of a streamed map, of all of it. */
  highlightedCount() {
    let number = 0;
    if (this.scene.tallies) {
      for (const [nodes, count] of this.scene.tallies.classes) {
        number += this.highlighted.matchesNodes(nodes) ? count : 0;
      }
      return number;
    }
    for (let i = 0; i < this.scene.count; i++) number += this.highlighted.matches(i) ? 1 : 0;
    return number;
  }
}

/** Nodes that match any of some texts, which commas separate. */
function matchingNodes(tree, text) {
  return [...new Set(text.split(",").flatMap((part) => nodesNamed(tree, part)))];
}

/** Nodes with this name, otherwise nodes whose name or path contains the text. */
function nodesNamed(tree, text) {
  const wanted = text.trim().toLowerCase();
  if (!tree || !wanted) return [];
  const indices = [...tree.nodes.keys()];
  const name = (i) => tree.nodes[i].path.at(-1).toLowerCase();
  const exact = indices.filter((i) => name(i) === wanted);
  if (exact.length) return exact;
  const path = (i) => tree.nodes[i].path.join(" > ").toLowerCase();
  return indices.filter((i) => name(i).includes(wanted) || (wanted.includes(">") && path(i).includes(wanted)));
}

const brightness = ([r, g, b]) => 0.299 * r + 0.587 * g + 0.114 * b;

function confidenceColour(value) {
  const place = (value / 255) * (CONFIDENCE_STOPS.length - 1);
  const lower = Math.min(Math.floor(place), CONFIDENCE_STOPS.length - 2);
  return [0, 1, 2].map((c) => CONFIDENCE_STOPS[lower][c]
    + (place - lower) * (CONFIDENCE_STOPS[lower + 1][c] - CONFIDENCE_STOPS[lower][c]));
}

/** Well separated colours: the hue advances by the golden angle. */
function submapColour(number) {
  const hue = (number * 0.61803399 + 0.58) % 1;
  const channel = (shift) => {
    const k = (shift + hue * 12) % 12;
    return 255 * (0.58 - 0.32 * Math.max(-1, Math.min(k - 3, 9 - k, 1)));
  };
  return [channel(0), channel(8), channel(4)].map(Math.round);
}
