// Connects scene, view and controls. Pictures are drawn only when something has changed.

const NO_WEBGL = "This browser offers no WebGL2, which the viewer needs. Use a current version of "
  + "Chrome, Edge, Firefox or Safari, and enable hardware acceleration.";

// A view of a streamed map is still this long after its last motion.
const REST_MS = 250;

class Viewer {
  constructor(canvas, gl, scene) {
    Object.assign(this, { canvas, gl, scene });
    this.camera = new ViewCamera(scene);
    this.frames = 0; // drawn with the order of their own view
    this.dirty = false;
    this.scale = 1; // of the picture, less while a streamed map moves on slow graphics
    this.lines = new LineRenderer(gl, scene);
    this.detail = scene.stream ? new DetailStream(scene, () => this.arrived()) : null;
    this.splats = new SplatRenderer(gl, scene, (current) => this.redraw(current));
    this.colouring = new Colouring(scene);
    this.pace = scene.stream ? new Pace(gl, scene.stream.budget) : null;
    if (this.detail) this.detail.start(this.splats, this.colouring);
    else {
      this.splats.upload(scene, 0, scene.count, 0);
      this.splats.partsChanged();
    }
    this.panel = new Panel(scene, this.colouring, this.actions());
    this.navigation = new Navigation(
      canvas, this.camera, () => this.moved(), (x, y) => this.click(x, y));
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  actions() {
    return {
      colours: () => { this.recolour(); this.redraw(true); },
      layer: (name, shown) => { this.lines.shown[name] = shown; this.redraw(true); },
      reset: () => { this.camera.reset(this.scene); this.moved(); },
      overview: () => { this.camera.showAll(this.scene); this.moved(); },
      navigation: () => {
        this.navigation.flying = !this.navigation.flying;
        this.panel.setNavigation(this.navigation.flying);
      },
      object: (number) => { this.lines.chooseObject(number); this.redraw(true); },
      lookAt: (number) => this.lookAtObject(number),
      viewFrom: (keyframe) => { this.camera.setPose(keyframe.pose); this.moved(); },
    };
  }

  /** Look at an object of the scene graph. */
  lookAtObject(number) {
    const { corners } = this.scene.objects[number];
    const [low, high] = [corners.slice(0, 3), corners.slice(21, 24)];
    const middle = scale(add(low, high), 0.5);
    this.camera.lookAt(middle, 1.2 * norm(sub(high, low)));
    this.moved();
  }

  get pixelRatio() { return this.scale * Math.min(devicePixelRatio || 1, 2); }

  resize() {
    this.setScale(this.scale);
    this.moved();
  }

  /** Set the size of the next picture. The canvas follows then, because that clears it. */
  setScale(scale) {
    const { canvas, camera } = this;
    this.scale = scale;
    camera.width = Math.max(1, Math.round(canvas.clientWidth * this.pixelRatio));
    camera.height = Math.max(1, Math.round(canvas.clientHeight * this.pixelRatio));
  }

  recolour() {
    this.splats.viewDependent = this.colouring.observed;
    if (this.detail) this.detail.recolour();
    else this.splats.setColours(0, this.colouring.rgba(0, this.scene.count));
  }

  moved() {
    if (this.detail) {
      this.moving = true;
      this.awaitRest();
      this.setScale(this.pace.scale);
      this.detail.choose(this.camera, this.pace.moving);
    }
    this.splats.sort(this.camera);
    this.redraw(false);
  }

  /** While a picture is drawn, motions may be waiting behind it. */
  awaitRest() {
    clearTimeout(this.rest);
    this.rest = setTimeout(() => (this.pace.busy ? this.awaitRest() : this.rested()), REST_MS);
  }

  /** The view is still: refine it. */
  rested() {
    this.moving = false;
    this.setScale(1);
    this.detail.choose(this.camera, this.pace.still);
    this.splats.sort(this.camera);
  }

  /** More of the map has been loaded; pictures may take longer than the next part. */
  arrived() {
    this.arrival ??= setTimeout(() => {
      this.arrival = undefined;
      if (this.detail.update()) this.splats.sort(this.camera);
      else this.redraw(true);
    }, clamp(2 * this.pace.frameMs, 30, 1500));
  }

  /** A picture of a streamed map is finished. */
  finished() {
    const { detail, pace, splats } = this;
    if (this.waiting) requestAnimationFrame((time) => this.draw(time));
    if (this.moving) this.awaitRest();
    const still = !this.moving && !this.arrival && detail.complete && !splats.outdated && !splats.busy;
    const grown = still && detail.limited && pace.grow();
    if (grown) this.rested();
    this.canvas.dataset.complete = still && !grown;
  }

  /** Draw soon; `current` says that the order of the Gaussians belongs to this view. */
  redraw(current) {
    this.current = current && !this.splats.busy;
    if (this.dirty) return;
    this.dirty = true;
    requestAnimationFrame((time) => this.draw(time));
  }

  draw(time) {
    this.waiting = Boolean(this.pace?.busy);
    if (this.waiting) return;
    this.dirty = false;
    const held = this.navigation?.step((time - (this.lastTime ?? time)) / 1000);
    this.lastTime = this.navigation?.keys.size ? time : undefined;
    const { gl, camera, canvas } = this;
    if (canvas.width !== camera.width) canvas.width = camera.width;
    if (canvas.height !== camera.height) canvas.height = camera.height;
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearColor(0.05, 0.062, 0.082, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.splats.draw(camera);
    this.lines.draw(camera, this.pixelRatio);
    if (this.current && this.splats.visible) this.canvas.dataset.frames = ++this.frames;
    this.pace?.began(this.moving, () => this.finished());
    if (held) this.moved();
    else if (this.navigation?.keys.size) this.redraw(false);
  }

  /** Show what lies at a pixel of the page; returns it. */
  click(x, y) {
    const box = this.canvas.getBoundingClientRect();
    const pixel = [(x - box.left) * this.pixelRatio, (y - box.top) * this.pixelRatio];
    const number = this.lines.shown.keyframes
      ? pickKeyframe(this.scene, this.camera, ...pixel, this.pixelRatio) : null;
    const keyframe = number === null ? null : this.scene.keyframes[number];
    this.lines.choose(number);
    this.panel.showKeyframe(keyframe);
    const splat = keyframe ? null : pickSplat(this.scene, this.camera, ...pixel);
    const found = splat === null ? null : describeSplat(this.scene, splat);
    if (!keyframe) this.panel.chooseObject(found && objectOf(this.scene, found));
    this.panel.showSplat(found);
    this.redraw(true);
    return keyframe ?? found;
  }
}

function showMessage(text) {
  byId("message").textContent = text;
  byId("message").hidden = false;
  byId("panel").hidden = true;
}

function start() {
  const canvas = byId("view");
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
  if (!gl) {
    showMessage(NO_WEBGL);
    return;
  }
  canvas.addEventListener("webglcontextlost", () =>
    showMessage("The graphics driver has stopped the 3D view. Reload the page."));
  window.semsplatViewer = new Viewer(canvas, gl, readScene());
}

start();
