// A map that `semsplat view` sends, and sends anew while its run is in progress.

const POLL_MS = 1000;
const LOST = "semsplat view does not answer. The map that is loaded remains visible.";

class ServedMap {
  /** `show(scene)` is called with each map, `tell(text)` with a line about it. */
  constructor(show, tell) {
    Object.assign(this, { show, tell });
    this.version = 0; // of the map that is shown
  }

  /** Load the map if it is new, again and again while it may change. */
  async poll() {
    if (this.polling) return;
    this.polling = true;
    clearTimeout(this.timer);
    const begin = performance.now();
    const state = await ask("state", (answer) => answer.json());
    this.tell(state ? state.message : LOST);
    if (state && state.version && state.version !== this.version) {
      const buffer = await ask("scene", (answer) => answer.arrayBuffer());
      const scene = buffer && readScene(buffer);
      if (scene) this.version = scene.version;
      if (scene) this.show(scene);
    }
    this.polling = false;
    const final = state?.finished && state.version === this.version;
    if (!final) this.later(Math.max(POLL_MS, performance.now() - begin));
  }

  /** Poll again after some time; a page that is not visible does not load the machine. */
  later(milliseconds) {
    this.timer = setTimeout(() => {
      if (document.hidden) addEventListener("visibilitychange", () => this.poll(), { once: true });
      else this.poll();
    }, milliseconds);
  }
}

/** The content of an answer; null if there is none. */
async function ask(path, content) {
  try {
    const answer = await fetch(path);
    return answer.ok ? await content(answer) : null;
  } catch {
    return null;
  }
}
