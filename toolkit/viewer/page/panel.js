// The controls beside the view.

const LAYERS = [["path", "camera path"], ["keyframes", "keyframes"], ["loops", "loops"]];
const HELP = {
  orbit: "Drag to turn, right drag or Shift to move, wheel to zoom. Click a Gaussian or a keyframe.",
  fly: "Drag to look around; W A S D to move, Q and E down and up. Click a Gaussian or a keyframe.",
};

const byId = (id) => document.getElementById(id);

class Panel {
  /** `actions` are called when a control changes. */
  constructor(scene, colouring, actions) {
    Object.assign(this, { scene, colouring, actions });
    byId("title").textContent = scene.title;
    byId("counts").textContent = countsText(scene);
    this.buildNotes();
    this.buildModes();
    this.buildLevels();
    this.buildSearch();
    this.buildGraph();
    this.buildLayers();
    this.buildButtons();
    if (scene.highlight) byId("query").value = scene.highlight;
    if (scene.highlight) this.search(scene.highlight);
    else this.refresh();
  }

  buildNotes() {
    const { notes } = this.scene;
    byId("reliability").hidden = !notes.length;
    byId("notes").append(...notes.map((textContent) => element("li", { textContent })));
  }

  buildModes() {
    this.modes = new Map();
    const modes = colourModes(this.scene);
    byId("modes").hidden = modes.length < 2;
    for (const [mode, name] of modes) {
      const button = element("button", { type: "button", role: "radio", textContent: name });
      button.onclick = () => this.setMode(mode);
      byId("modes").append(button);
      this.modes.set(mode, button);
    }
  }

  buildLevels() {
    const slider = byId("level-slider");
    byId("level").hidden = !this.scene.levels.length;
    slider.max = Math.max(this.scene.levels.length - 1, 0);
    slider.value = this.colouring.level;
    slider.oninput = () => this.setLevel(Number(slider.value));
  }

  buildSearch() {
    byId("class-search").hidden = !this.scene.levels.length;
    byId("query").oninput = () => this.search(byId("query").value);
  }

  /** The scene graph as a tree: storeys if there are several, rooms, and the objects in them. */
  buildGraph() {
    const objects = this.scene.objects ?? [];
    byId("graph").hidden = !objects.length;
    this.entries = [];
    const all = objects.map((_, number) => number);
    for (const [storey, numbers] of grouped(all, (number) => objects[number].storey ?? "")) {
      const top = storey ? branch(storey, numbers, true) : byId("graph");
      const rooms = grouped(numbers, (number) => objects[number].room);
      for (const [room, inside] of rooms) {
        const entry = branch(room || "no room", inside, rooms.size === 1);
        for (const number of inside) entry.append(...this.objectEntry(number));
        top.append(entry);
      }
      if (storey) byId("graph").append(top);
    }
  }

  /** An entry of the tree, and its size and relations, which are shown while it is chosen. */
  objectEntry(number) {
    const { name, corners, relations } = this.scene.objects[number];
    const button = element("button", { type: "button", textContent: name, title: name });
    button.setAttribute("aria-pressed", false);
    const list = element("ul", { className: "soft", hidden: true });
    const lines = [`${sizeText(corners)} ${this.scene.length}`, ...relations];
    list.append(...lines.map((textContent) => element("li", { textContent })));
    button.onclick = () => {
      this.chooseObject(this.chosenObject === number ? null : number);
      if (this.chosenObject === number) this.actions.lookAt(number);
    };
    this.entries[number] = { button, list };
    return [button, list];
  }

  /** Show the entry of an object and mark the object; null for none. */
  chooseObject(number) {
    this.chosenObject = number;
    this.entries.forEach(({ button, list }, other) => {
      button.setAttribute("aria-pressed", other === number);
      list.hidden = other !== number;
    });
    if (number !== null) {
      const { button, list } = this.entries[number];
      for (let room = button.closest("details"); room; room = room.parentElement.closest("details")) {
        room.open = true;
      }
      list.scrollIntoView({ block: "nearest" });
    }
    this.actions.object(number);
  }

  buildLayers() {
    const present = {
      path: this.scene.path.length > 3, keyframes: this.scene.keyframes.length,
      loops: this.scene.loops.length,
    };
    const shown = LAYERS.filter(([layer]) => present[layer]);
    byId("layers").hidden = !shown.length;
    for (const [layer, name] of shown) {
      const box = element("input", { type: "checkbox", checked: true, id: `layer-${layer}` });
      box.onchange = () => this.actions.layer(layer, box.checked);
      const label = element("label");
      label.append(box, layer === "loops" ? `${present.loops} loops` : name);
      byId("layers").append(label);
    }
  }

  buildButtons() {
    byId("reset").onclick = () => this.actions.reset();
    byId("overview").onclick = () => this.actions.overview();
    byId("navigation").onclick = () => this.actions.navigation();
    byId("fold").onclick = () => this.fold();
    addEventListener("keydown", (event) => {
      if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey) return;
      const key = event.key.toLowerCase();
      if (key === "r") this.actions.reset();
      if (key === "o") this.actions.overview();
      if (key === "f") this.actions.navigation();
      if (key === "h") this.fold();
    });
    this.setNavigation(false);
  }

  fold() {
    const controls = byId("controls");
    controls.hidden = !controls.hidden;
    byId("fold").textContent = controls.hidden ? "+" : "–";
  }

  setNavigation(flying) {
    byId("navigation").textContent = flying ? "Flying" : "Orbiting";
    byId("help").textContent = flying ? HELP.fly : HELP.orbit;
  }

  setMode(mode) {
    this.colouring.mode = mode;
    this.clearSearch();
    this.refresh();
  }

  setLevel(level) {
    this.colouring.mode = "classes";
    this.colouring.level = level;
    byId("level-slider").value = level;
    // A search stays: its classes exist at other levels too. A choice in the legend does not.
    if (byId("query").value) this.colouring.highlightText(byId("query").value);
    else this.colouring.highlightKeys(new Set());
    this.refresh();
  }

  search(text) {
    const nodes = this.colouring.highlightText(text);
    if (text.trim() && this.colouring.mode === "colour") this.colouring.mode = "classes";
    byId("query-result").textContent = this.searchText(text, nodes);
    if (!nodes.length) this.colouring.highlightKeys(new Set());
    this.refresh();
  }

  searchText(text, nodes) {
    if (!text.trim()) return "";
    if (!nodes.length) return "No class has this name.";
    const names = nodes.map((node) => this.scene.tree.nodes[node].path.at(-1));
    const first = names.slice(0, 3).join(", ") + (names.length > 3 ? ", ..." : "");
    return `${first}: ${this.colouring.highlightedCount().toLocaleString("en")} Gaussians`;
  }

  clearSearch() {
    byId("query").value = "";
    byId("query-result").textContent = "";
    this.colouring.highlightKeys(new Set());
  }

  /** Show the state of the colouring. */
  refresh() {
    const { mode, level } = this.colouring;
    for (const [name, button] of this.modes) button.setAttribute("aria-checked", name === mode);
    if (this.scene.levels.length) {
      byId("level-name").textContent =
        `${level + 1} of ${this.scene.levels.length}: ${this.scene.tree.levels[level]}`;
    }
    this.showLegend();
    this.actions.colours();
  }

  showLegend() {
    const entries = this.colouring.legend();
    byId("legend-section").hidden = !entries.length;
    const keys = this.colouring.highlighted?.keys ?? new Set();
    byId("legend").replaceChildren(...entries.map((entry) => this.legendRow(entry, keys)));
  }

  legendRow({ key, name, rgb, fraction }, keys) {
    const button = element("button", { type: "button", title: name });
    button.setAttribute("aria-pressed", keys.has(key));
    const swatch = element("i");
    swatch.style.background = `rgb(${rgb.join(",")})`;
    const percent = fraction < 0.001 ? "< 0.1 %" : `${(100 * fraction).toFixed(1)} %`;
    button.append(swatch, element("span", { textContent: name }), element("small", { textContent: percent }));
    button.onclick = () => this.toggle(key);
    const row = element("li");
    row.append(button);
    return row;
  }

  toggle(key) {
    const keys = new Set(byId("query").value ? [] : this.colouring.highlighted?.keys ?? []);
    if (!keys.delete(key)) keys.add(key);
    this.clearSearch();
    this.colouring.highlightKeys(keys);
    this.refresh();
  }

  showSplat(found) {
    const section = byId("picked");
    section.hidden = !found;
    if (!found) return;
    byId("help").hidden = true;
    const rows = [["position", `${found.position.map((v) => v.toFixed(2)).join("  ")} ${this.scene.length}`]];
    if (found.submap !== null) rows.unshift(["submap", String(found.submap)]);
    if (found.inferred !== null) rows.unshift(["depth", found.inferred ? "inferred" : "measured"]);
    if (found.confidence !== null) rows.unshift(["confidence", `${Math.round(100 * found.confidence)} %`]);
    if (this.scene.levels.length) rows.unshift(["class", found.classPath.join(" > ") || "unknown"]);
    const list = element("dl");
    for (const [name, value] of rows) {
      list.append(element("dt", { textContent: name }), element("dd", { textContent: value }));
    }
    section.replaceChildren(list);
    section.scrollIntoView({ block: "nearest" });
  }

  showKeyframe(keyframe) {
    const section = byId("keyframe");
    section.hidden = !keyframe;
    if (!keyframe) return;
    const row = element("div", { className: "row" });
    const view = element("button", { type: "button", textContent: "View from here" });
    view.onclick = () => this.actions.viewFrom(keyframe);
    row.append(element("span", { textContent: `Keyframe ${keyframe.index}` }), view);
    const image = keyframe.image
      ? element("img", { src: keyframe.image, alt: `image of keyframe ${keyframe.index}` })
      : element("p", { className: "soft", textContent: "The image is not part of this page." });
    // Known before the image is decoded, so that all of it is scrolled into view.
    if (keyframe.image) image.style.aspectRatio = `${this.scene.camera.width} / ${this.scene.camera.height}`;
    section.replaceChildren(row, image);
    section.scrollIntoView({ block: "nearest" });
  }
}

function countsText({ count, total, stream }) {
  const number = (value) => value.toLocaleString("en");
  if (stream) return `${number(total)} Gaussians, at most ${number(stream.budget)} at once`;
  return count < total ? `${number(count)} of ${number(total)} Gaussians` : `${number(count)} Gaussians`;
}

/** The values with the same key, in their order. */
function grouped(values, keyOf) {
  const groups = new Map();
  for (const value of values) {
    const key = keyOf(value);
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(value);
  }
  return groups;
}

/** A branch of the tree of objects, with their number. */
function branch(name, objects, open) {
  const details = element("details", { open });
  details.append(element("summary", { textContent: `${name} (${objects.length})` }));
  return details;
}

/** The lengths of the edges of a box. */
function sizeText(corners) {
  const corner = (number) => corners.slice(3 * number, 3 * number + 3);
  return [1, 2, 4].map((number) => norm(sub(corner(number), corner(0))).toFixed(2)).join(" x ");
}

function element(name, properties = {}) {
  const created = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (key === "role") created.setAttribute(key, value);
    else created[key] = value;
  }
  return created;
}
