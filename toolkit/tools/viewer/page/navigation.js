// Mouse, touch and keyboard: orbit around a target, or fly.

const TURN_RAD_PER_PIXEL = 0.005;
const CLICK_PIXELS = 5;
const FLY_KEYS = {
  w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0],
  arrowup: [0, 0, 1], arrowdown: [0, 0, -1], arrowleft: [-1, 0, 0], arrowright: [1, 0, 0],
};

class Navigation {
  /** `changed()` is called after the camera moved, `clicked(x, y)` with CSS pixels. */
  constructor(canvas, camera, changed, clicked) {
    Object.assign(this, { canvas, camera, changed, clicked });
    this.flying = false;
    this.pointers = new Map();
    this.keys = new Set();
    this.travelled = 0;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => this.release(event, true));
    canvas.addEventListener("pointercancel", (event) => this.release(event, false));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.keys.clear());
  }

  press(event) {
    this.canvas.focus();
    this.canvas.setPointerCapture(event.pointerId);
    if (!this.pointers.size) this.travelled = 0;
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - last[0], now[1] - last[1]];
    this.travelled += Math.abs(dx) + Math.abs(dy);
    if (this.pointers.size === 2) this.pinch(event.pointerId, last, now);
    else if (event.shiftKey || event.buttons & 6) this.pan(dx, dy);
    else {
      // The scene follows the pointer: the camera moves around it, or looks the other way.
      const sign = this.flying ? -1 : 1;
      this.camera.turn(
        sign * dx * TURN_RAD_PER_PIXEL, -sign * dy * TURN_RAD_PER_PIXEL, this.flying);
    }
    this.pointers.set(event.pointerId, now);
    this.changed();
  }

  pan(dx, dy) {
    const metres = this.camera.distance / (this.canvas.clientHeight / 2 / Math.tan(FOV_Y_RAD / 2));
    this.camera.move(-dx * metres, -dy * metres, 0);
  }

  /** Two fingers: their distance zooms, their motion pans. */
  pinch(moved, last, now) {
    const [other] = [...this.pointers].filter(([id]) => id !== moved).map(([, place]) => place);
    const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
    const after = Math.hypot(now[0] - other[0], now[1] - other[1]);
    this.camera.zoom(before / Math.max(after, 1));
    this.pan((now[0] - last[0]) / 2, (now[1] - last[1]) / 2);
  }

  release(event, mayClick) {
    const known = this.pointers.delete(event.pointerId);
    const still = this.travelled < CLICK_PIXELS;
    if (mayClick && known && still && event.button === 0) this.clicked(event.clientX, event.clientY);
  }

  wheel(event) {
    event.preventDefault();
    const step = clamp(event.deltaY * (event.deltaMode ? 16 : 1), -120, 120);
    if (this.flying) this.camera.move(0, 0, -step * 0.004 * this.speed);
    else this.camera.zoom(Math.exp(step * 0.0015));
    this.changed();
  }

  key(event, down) {
    if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase();
    if (!(key in FLY_KEYS)) return;
    if (down) this.keys.add(key);
    else this.keys.delete(key);
    this.changed();
  }

  /** Metres per second of the keys. */
  get speed() { return clamp(this.camera.distance * 0.6, 0.5, 10); }

  /** Move by the keys that are held; returns whether the camera moved. */
  step(seconds) {
    if (!this.keys.size) return false;
    const metres = this.speed * Math.min(seconds, 0.1);
    for (const key of this.keys) this.camera.move(...scale(FLY_KEYS[key], metres));
    return true;
  }
}
