// Connects scene, view and controls. Pictures are drawn only when something has changed.

// A view of a streamed map is still this long after its last motion.
const REST_MS = 250;

class Viewer {
  /** `outdated()` is called if the server has another map than the one that is streamed. */
  constructor(canvas, gl, scene, outdated) {
    Object.assign(this, { canvas, gl, outdated });
    this.camera = new ViewCamera(scene);
    this.frames = 0; // drawn with the order of their own view
    this.dirty = false;
    this.keyframe = null; // the chosen one
    this.lines = new LineRenderer(gl);
    this.colouring = new Colouring(scene);
    this.panel = new Panel(this.colouring, this.actions());
    this.setScale(1);
    this.show(scene);
    this.navigation = new Navigation(
      canvas, this.camera, () => this.moved(), (x, y) => this.click(x, y));
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  /** Show a scene, the first one or another state of it. The view and what is chosen stay. */
  show(scene) {
    const { gl } = this;
    this.scene = scene;
    this.camera.adopt(scene);
    this.colouring.adopt(scene);
    this.detail?.end();
    clearTimeout(this.rest);
    clearTimeout(this.arrival);
    this.moving = false;
    this.arrival = undefined;
    if (this.splats !== this.drawn) this.splats.dispose(); // one that has not been drawn so far
    this.detail = scene.stream
      ? new DetailStream(scene, () => this.arrived(), () => this.outdated()) : null;
    const splats = new SplatRenderer(gl, scene, (current) => this.sorted(splats, current));
    this.splats = splats;
    this.pace = scene.stream ? new Pace(gl, scene.stream.budget) : null;
    this.setScale(1); // of the picture, less while a streamed map moves on slow graphics
    if (this.detail) this.detail.start(splats, this.colouring);
    else {
      splats.upload(scene, 0, scene.count, 0);
      splats.partsChanged();
    }
    const { index } = this.keyframe ?? {};
    this.keyframe = scene.keyframes.find((keyframe) => keyframe.index === index) ?? null;
    if (!this.keyframe) this.panel.showKeyframe(null);
    this.lines.show(scene, this.keyframe);
    this.panel.show(scene);
    this.moved();
  }

  /** There is a new order; what was drawn before the first one is replaced now. */
  sorted(splats, current) {
    if (this.drawn !== splats) {
      this.drawn?.dispose();
      this.drawn = splats;
      this.canvas.dataset.version = this.scene.version;
    }
    this.redraw(current);
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
      object: (object) => { this.lines.chooseObject(object); this.redraw(true); },
      lookAt: (object) => this.lookAtObject(object),
      viewFrom: () => { this.camera.setPose(this.keyframe.pose); this.moved(); },
    };
  }

  /** Look at an object of the scene graph. */
  lookAtObject({ corners }) {
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
    if (!detail) return; // another map is shown by now
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
    this.drawn?.draw(camera);
    this.lines.draw(camera, this.pixelRatio);
    if (this.current && this.drawn?.visible) this.canvas.dataset.frames = ++this.frames;
    this.pace?.began(this.moving, () => this.finished());
    if (held) this.moved();
    else if (this.navigation?.keys.size) this.redraw(false);
  }

  /** Show what lies at a pixel of the page; returns it. */
  click(x, y) {
    const box = this.canvas.getBoundingClientRect();
    const pixel = [(x - box.left) * this.pixelRatio, (y - box.top) * this.pixelRatio];
    const keyframe = this.lines.shown.keyframes
      ? pickKeyframe(this.scene, this.camera, ...pixel, this.pixelRatio) : null;
    this.keyframe = keyframe;
    this.lines.choose(keyframe);
    this.panel.showKeyframe(keyframe);
    const splat = keyframe ? null : pickSplat(this.scene, this.camera, ...pixel);
    const found = splat === null ? null : describeSplat(this.scene, splat);
    if (!keyframe) this.panel.objects.choose((found && objectOf(this.scene, found))?.number ?? null);
    this.panel.showSplat(found);
    this.redraw(true);
    return keyframe ?? found;
  }
}
