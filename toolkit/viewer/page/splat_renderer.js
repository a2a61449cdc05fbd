// Draws the Gaussians from far to near.

const TEXTURE_WIDTH = 2048;

class SplatRenderer {
  constructor(gl, scene, sortedAnew) {
    Object.assign(this, { gl, scene, sortedAnew });
    const { program, uniforms } = buildProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    Object.assign(this, { program, uniforms });
    this.positions = this.floatTexture(0, positionTexels(scene), scene.count);
    this.shapes = this.floatTexture(2, scene.shapes ? shapeTexels(scene) : new Float32Array(8), scene.shapes ? 2 * scene.count : 2);
    this.colours = gl.createTexture();
    this.array = quadArray(gl);
    this.order = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(1, 1);
    gl.bindVertexArray(null);
    this.visible = 0;
    this.busy = false;
    this.pending = null;
    this.serial = 0;
    this.worker = sortWorker();
    this.worker.onmessage = ({ data }) => this.receive(data);
    this.worker.postMessage({ means: scene.means, sigmas: scene.sigmas });
  }

  floatTexture(unit, values, texels) {
    const { gl } = this;
    const texture = gl.createTexture();
    const rows = Math.ceil(texels / TEXTURE_WIDTH);
    const padded = new Float32Array(TEXTURE_WIDTH * rows * 4);
    padded.set(values);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, TEXTURE_WIDTH, rows, 0, gl.RGBA, gl.FLOAT, padded);
    unfiltered(gl);
    return texture;
  }

  /** Set the colours [4 N] of all Gaussians. */
  setColours(rgba) {
    const { gl } = this;
    const rows = Math.ceil(this.scene.count / TEXTURE_WIDTH);
    const padded = new Uint8Array(TEXTURE_WIDTH * rows * 4);
    padded.set(rgba);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.colours);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, TEXTURE_WIDTH, rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, padded);
    unfiltered(gl);
  }

  /** Ask for the order of a view; while one is computed, only the newest request waits. */
  sort(camera) {
    const { rows, eye } = camera.view;
    // Beyond the image, so that a turn does not show gaps before the next order arrives.
    const slopeX = (0.65 * camera.width) / camera.focal, slopeY = (0.65 * camera.height) / camera.focal;
    const request = { rows, eye, slopeX, slopeY, near: NEAR_M, serial: ++this.serial };
    if (this.busy) this.pending = request;
    else this.send(request);
  }

  send(request) {
    this.busy = true;
    this.worker.postMessage(request);
  }

  receive({ order, serial }) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.visible = order.length;
    this.busy = false;
    if (this.pending) {
      this.send(this.pending);
      this.pending = null;
    }
    this.sortedAnew(serial === this.serial);
  }

  draw(camera) {
    const { gl, uniforms } = this;
    gl.useProgram(this.program);
    setView(gl, uniforms, camera);
    gl.uniform1i(uniforms.positions, 0);
    gl.uniform1i(uniforms.colours, 1);
    gl.uniform1i(uniforms.shapes, 2);
    gl.uniform1i(uniforms.anisotropic, this.scene.shapes ? 1 : 0);
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.visible);
    gl.bindVertexArray(null);
  }
}

function positionTexels({ means, sigmas }) {
  const texels = new Float32Array(4 * sigmas.length);
  for (let i = 0; i < sigmas.length; i++) {
    texels.set(means.subarray(3 * i, 3 * i + 3), 4 * i);
    texels[4 * i + 3] = sigmas[i];
  }
  return texels;
}

function shapeTexels({ shapes, count }) {
  const texels = new Float32Array(8 * count);
  for (let i = 0; i < count; i++) texels.set(shapes.subarray(6 * i, 6 * i + 6), 8 * i);
  return texels;
}

/** A vertex array with the corners of a square as attribute 0; it stays bound. */
function quadArray(gl) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  return array;
}

function unfiltered(gl) {
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
}

/** The worker that sorts; its source is embedded, because the page is one file. */
function sortWorker() {
  const source = document.getElementById("sort-worker").textContent;
  const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
  const worker = new Worker(url);
  URL.revokeObjectURL(url);
  return worker;
}
