// The controls beside the view.

const LAYERS = [["path", "camera path"], ["keyframes", "keyframes"], ["loops", "loops"]];
const HELP = {
  orbit: "Drag to turn, right drag or Shift to move, wheel to zoom. Click a Gaussian or a keyframe.",
  fly: "Drag to look around; W A S D to move, Q and E down and up. Click a Gaussian or a keyframe.",
};

class Panel {
  /** `actions` are called when a control changes. */
  constructor(colouring, actions) {
    Object.assign(this, { colouring, actions });
    byId("panel").hidden = false;
    this.modes = new KeyedElements((mode) => {
      const button = element("button", { type: "button", role: "radio" });
      button.onclick = () => this.setMode(mode);
      return button;
    });
    this.rows = new KeyedElements((key) => this.legendRow(key));
    this.objects = new ObjectTree(byId("graph"), actions.object, actions.lookAt);
    byId("level-slider").oninput = () => this.setLevel(Number(byId("level-slider").value));
    byId("query").oninput = () => this.search(byId("query").value);
    this.buildLayers();
    this.buildButtons();
  }

  /** Show a scene, the first one or another state of it. What was chosen stays. */
  show(scene) {
    if (!this.scene && scene.highlight) byId("query").value = scene.highlight;
    this.scene = scene;
    document.title = scene.title;
    byId("title").textContent = scene.title;
    byId("counts").textContent = countsText(scene);
    byId("reliability").hidden = !scene.notes.length;
    byId("notes").replaceChildren(...scene.notes.map((textContent) => element("li", { textContent })));
    this.showModes();
    byId("level").hidden = byId("class-search").hidden = !scene.levels.length;
    byId("level-slider").max = Math.max(scene.levels.length - 1, 0);
    byId("level-slider").value = this.colouring.level;
    this.objects.show(scene.objects, scene.length);
    this.showLayers();
    if (byId("query").value) this.search(byId("query").value);
    else this.refresh();
  }

  showModes() {
    const modes = colourModes(this.scene);
    byId("colours").hidden = modes.length < 2;
    this.modes.keep(modes.map(([mode]) => mode));
    arrange(byId("modes"), modes.map(([mode, name]) => {
      setText(this.modes.get(mode), name);
      return this.modes.get(mode);
    }));
  }

  buildLayers() {
    this.layers = LAYERS.map(([layer, name]) => {
      const box = element("input", { type: "checkbox", checked: true, id: `layer-${layer}` });
      box.onchange = () => this.actions.layer(layer, box.checked);
      const label = element("label"), text = element("span", { textContent: name });
      label.append(box, text);
      byId("layers").append(label);
      return { layer, label, text };
    });
  }

  showLayers() {
    const { path, keyframes, loops } = this.scene;
    const present = { path: path.length > 3, keyframes: keyframes.length, loops: loops.length };
    byId("layers").hidden = !Object.values(present).some(Boolean);
    for (const { layer, label, text } of this.layers) {
      label.hidden = !present[layer];
      if (layer === "loops") setText(text, `${loops.length} loops`);
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
    for (const [name, button] of this.modes.elements) button.setAttribute("aria-checked", name === mode);
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
    const chosen = this.colouring.highlighted?.keys ?? new Set();
    this.rows.keep(entries.map(({ key }) => key));
    arrange(byId("legend"), entries.map(({ key, name, rgb, fraction }) => {
      const row = this.rows.get(key);
      const [button] = row.children, [swatch, label, share] = button.children;
      button.title = name;
      button.setAttribute("aria-pressed", chosen.has(key));
      swatch.style.background = `rgb(${rgb.join(",")})`;
      setText(label, name);
      setText(share, fraction < 0.001 ? "< 0.1 %" : `${(100 * fraction).toFixed(1)} %`);
      return row;
    }));
  }

  legendRow(key) {
    const button = element("button", { type: "button" });
    button.append(element("i"), element("span"), element("small"));
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
    view.onclick = () => this.actions.viewFrom();
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
