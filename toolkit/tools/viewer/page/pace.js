// How many Gaussians are drawn at once, from the time that the pictures before have taken.

// In milliseconds: a picture in motion, and one of a still view, which a new motion has to await.
const MOVING_MS = 50;
const STILL_MS = 1500;
// The first pictures have this many. With fewer, pictures are not faster, but blurred: merged
// Gaussians cover the same pixels.
const LEAST_MOVING = 50000;
const LEAST_STILL = 250000;
// Pictures in motion become smaller instead, down to this share of the width.
const LEAST_SCALE = 0.25;

class Pace {
  /** At most `budget` Gaussians are drawn, however fast the graphics are. */
  constructor(gl, budget) {
    Object.assign(this, { gl, budget });
    this.moving = Math.min(LEAST_MOVING, budget);
    this.still = Math.min(LEAST_STILL, budget);
    this.scale = 1; // of pictures in motion
    this.frameMs = 0;
    this.busy = false;
  }

  /** Measure the picture that has just been submitted. */
  began(moving, finished) {
    const { gl } = this;
    const begin = performance.now();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.busy = true;
    const check = () => {
      const state = gl.getSyncParameter(fence, gl.SYNC_STATUS);
      if (state !== gl.SIGNALED && !gl.isContextLost()) {
        requestAnimationFrame(check);
        return;
      }
      gl.deleteSync(fence);
      this.busy = false;
      this.frameMs = performance.now() - begin;
      if (moving) this.adapt();
      finished();
    };
    requestAnimationFrame(check);
  }

  /** After a picture in motion: draw fewer Gaussians, then fewer pixels; or more of them. */
  adapt() {
    const factor = clamp(MOVING_MS / this.frameMs, 0.5, 1.25);
    const least = Math.min(LEAST_MOVING, this.budget);
    if (factor < 1 ? this.moving === least : this.scale < 1) {
      this.scale = clamp(Math.sqrt(factor) * this.scale, LEAST_SCALE, 1);
    } else this.moving = clamp(factor * this.moving, least, this.budget);
  }

  /** After the picture of a still view: allow more for it; false if that would take too long. */
  grow() {
    if (this.still === this.budget || this.frameMs > STILL_MS) {
      if (this.frameMs > 2 * STILL_MS) this.still = Math.max(this.still / 2, Math.min(LEAST_STILL, this.budget));
      return false;
    }
    this.still = Math.min(2 * this.still, this.budget);
    return true;
  }
}
