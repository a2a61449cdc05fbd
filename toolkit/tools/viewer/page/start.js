// Starts the page: with the scene that it contains, or with the one that its server sends.

const NO_WEBGL = "This browser offers no WebGL2, which the viewer needs. Use a current version of "
  + "Chrome, Edge, Firefox or Safari, and enable hardware acceleration.";

/** Show a text instead of the map. */
function showMessage(text) {
  byId("message").textContent = text;
  byId("message").hidden = !text;
  byId("panel").hidden ||= Boolean(text);
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
  const scene = embeddedScene();
  if (scene) {
    window.semsplatViewer = new Viewer(canvas, gl, scene);
    return;
  }
  const served = new ServedMap((next) => {
    if (window.semsplatViewer) window.semsplatViewer.show(next);
    else {
      showMessage("");
      window.semsplatViewer = new Viewer(canvas, gl, next, () => served.poll());
    }
  }, (text) => {
    if (!window.semsplatViewer) showMessage(text);
    byId("status").textContent = text;
    byId("status").hidden = !text;
  });
  served.poll();
}

start();
