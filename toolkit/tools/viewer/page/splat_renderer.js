// Draws the Gaussians from far to near.

const SPHERE = [1, 0, 0, 1, 0, 1];

class SplatRenderer {
  /** Draw `scene.parts` of at most `scene.capacity` Gaussians, which `upload` fills in. */
  constructor(gl, scene, sortedAnew) {
    Object.assign(this, { gl, scene, sortedAnew });
    const { program, uniforms } = buildProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    Object.assign(this, { program, uniforms });
    this.viewDependent = true;
    this.degree = [0, 3, 8, 15].indexOf(scene.harmonics ? scene.harmonics.length / (3 * scene.count) : 0);
    const anisotropic = Boolean(scene.shapes);
    this.textures = {
      positions: this.texture(0, 1, gl.RGBA32F, gl.RGBA, gl.FLOAT),
      colours: this.texture(1, 1, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE),
      shapes: this.texture(2, anisotropic ? 2 : 0, gl.RGBA32F, gl.RGBA, gl.FLOAT),
      // Degree 1 to 3 have 9, 24 and 45 bytes: 1, 2 and 3 texels of 16 bytes.
      harmonics: this.texture(3, this.degree, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT),
    };
    Object.assign(this, quadArray(gl));
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
    this.cut = this.drawnCut = 0; // numbers of states of `scene.parts`
    this.worker = sortWorker();
    this.worker.onmessage = ({ data }) => this.receive(data);
    this.worker.postMessage({ capacity: scene.capacity });
  }

  /** Free what the graphics processor and the worker hold. */
  dispose() {
    const { gl } = this;
    this.worker.onmessage = null;
    this.worker.terminate();
    for (const { texture } of Object.values(this.textures)) gl.deleteTexture(texture);
    for (const buffer of [this.corners, this.order]) gl.deleteBuffer(buffer);
    gl.deleteVertexArray(this.array);
  }

  /** A texture of `texels` per Gaussian; one texel in all if that is 0. */
  texture(unit, texels, internal, format, type) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    const rows = Math.max(Math.ceil(this.scene.capacity / ROW), 1);
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, Math.max(texels * ROW, 1), texels ? rows : 1);
    unfiltered(gl);
    return { texture, unit, texels, format, type };
  }

  /** Write values of `count` Gaussians from number `first` on into a texture. */
  write({ texture, unit, texels, format, type }, first, count, values) {
    const { gl } = this;
    const perSplat = values.length / count;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (let done = 0; done < count;) {
      const x = (first + done) % ROW, y = Math.floor((first + done) / ROW);
      const left = count - done;
      const rows = x ? 1 : Math.max(Math.floor(left / ROW), 1);
      const width = Math.min(left, ROW - x);
      const part = values.subarray(done * perSplat, (done + width * rows) * perSplat);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x * texels, y, width * texels, rows, format, type, part);
      done += width * rows;
    }
  }

  /** Store the Gaussians `begin` to `end` of decoded columns from number `first` on. */
  upload(columns, begin, end, first) {
    const { textures } = this;
    const count = end - begin;
    const means = columns.means.slice(3 * begin, 3 * end), sigmas = columns.sigmas.slice(begin, end);
    this.write(textures.positions, first, count, positionTexels(means, sigmas));
    if (textures.shapes.texels) {
      this.write(textures.shapes, first, count, shapeTexels(columns.shapes, begin, end));
    }
    if (this.degree) {
      const texels = harmonicTexels(columns.harmonics, begin, end, this.degree);
      this.write(textures.harmonics, first, count, texels);
    }
    this.worker.postMessage({ first, means, sigmas }, [means.buffer, sigmas.buffer]);
  }

  /** Set the colours [4 N] of N Gaussians from number `first` on. */
  setColours(first, rgba) { this.write(this.textures.colours, first, rgba.length / 4, rgba); }

  /** Whether the picture does not show `scene.parts` yet. */
  get outdated() { return this.drawnCut !== this.cut; }

  /** Take over new `scene.parts` with the next order. */
  partsChanged() {
    this.cut++;
    this.worker.postMessage({ parts: this.scene.parts });
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
    this.worker.postMessage({ ...request, cut: this.cut });
  }

  receive({ order, serial, cut }) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.visible = order.length;
    this.drawnCut = cut;
    this.busy = false;
    if (this.pending) {
      this.send(this.pending);
      this.pending = null;
    }
    this.sortedAnew(serial === this.serial);
  }

  draw(camera) {
    const { gl, uniforms, textures } = this;
    gl.useProgram(this.program);
    setView(gl, uniforms, camera);
    for (const [name, { texture, unit }] of Object.entries(textures)) {
      // Another renderer, with the next state of the map, uses the same units.
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(uniforms[name], unit);
    }
    gl.uniform1i(uniforms.anisotropic, textures.shapes.texels ? 1 : 0);
    gl.uniform1i(uniforms.degree, this.viewDependent ? this.degree : 0);
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.visible);
    gl.bindVertexArray(null);
  }
}

function positionTexels(means, sigmas) {
  const texels = new Float32Array(4 * sigmas.length);
  for (let i = 0; i < sigmas.length; i++) {
    texels[4 * i] = means[3 * i];
    texels[4 * i + 1] = means[3 * i + 1];
    texels[4 * i + 2] = means[3 * i + 2];
    texels[4 * i + 3] = sigmas[i];
  }
  return texels;
}

/** Two texels per Gaussian; spheres of a map that has ellipsoids as well have no shapes. */
function shapeTexels(shapes, begin, end) {
  const texels = new Float32Array(8 * (end - begin));
  for (let i = begin; i < end; i++) {
    for (let k = 0; k < 6; k++) texels[8 * (i - begin) + k] = shapes ? shapes[6 * i + k] : SPHERE[k];
  }
  return texels;
}

/** The bytes of each Gaussian, padded to whole texels of four unsigned integers. */
function harmonicTexels(harmonics, begin, end, degree) {
  const bytes = new Int8Array(16 * degree * (end - begin));
  const length = 3 * (degree * (degree + 2));
  for (let i = begin; i < end; i++) {
    bytes.set(harmonics.subarray(length * i, length * (i + 1)), 16 * degree * (i - begin));
  }
  return new Uint32Array(bytes.buffer);
}

/** A vertex array with the corners of a square as attribute 0; it stays bound. */
function quadArray(gl) {
  const array = gl.createVertexArray(), corners = gl.createBuffer();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, corners);
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  return { array, corners };
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
