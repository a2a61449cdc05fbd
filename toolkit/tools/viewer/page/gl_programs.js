// Shaders, and their compilation.

// Gaussians per row of the textures; a Gaussian takes one or several texels of its row.
const ROW = 2048;

// Splats are squares that cover a projected Gaussian up to the visible threshold. Positions and
// colours come from textures, because a vertex only knows the number of its Gaussian.
const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp sampler2D;
precision highp usampler2D;
layout(location = 0) in vec2 corner;
layout(location = 1) in uint splat;
uniform sampler2D positions;   // x, y, z, sigma
uniform sampler2D shapes;      // two texels: xx, xy, xz, yy | yz, zz
uniform sampler2D colours;
uniform usampler2D harmonics;  // one texel per degree, signed bytes: red, green, blue of each
uniform bool anisotropic;
uniform int degree;            // of the harmonics, 0 for colours that do not depend on the view
uniform mat3 rotation;        // map to camera
uniform vec3 eye;
uniform float focal;          // pixels
uniform vec2 viewport;        // pixels
out vec4 colour;
out vec2 place;               // in standard deviations

const float NEAR = ${NEAR_M.toFixed(3)};
// Variance of the pixel, in square pixels, as usual for Gaussian splatting.
const float PIXEL_VARIANCE = 0.3;

const int ROW = ${ROW};

/** Place of the first of some texels of this Gaussian. */
ivec2 texel(int texels) { return ivec2(texels * (int(splat) % ROW), int(splat) / ROW); }

/** What the harmonics add to the colour, seen along d; signs and order are those of 3DGS. */
vec3 harmonicColour(vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float basis[15] = float[15](
    -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
    1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (2.0 * zz - xx - yy),
    -1.09254843 * x * z, 0.54627422 * (xx - yy),
    -0.59004359 * y * (3.0 * xx - yy), 2.89061144 * x * y * z,
    -0.45704580 * y * (4.0 * zz - xx - yy), 0.37317633 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
    -0.45704580 * x * (4.0 * zz - xx - yy), 1.44530572 * z * (xx - yy),
    -0.59004359 * x * (xx - 3.0 * yy));
  uint words[12];
  for (int i = 0; i < degree; i++) {
    uvec4 four = texelFetch(harmonics, texel(degree) + ivec2(i, 0), 0);
    words[4 * i] = four.x;
    words[4 * i + 1] = four.y;
    words[4 * i + 2] = four.z;
    words[4 * i + 3] = four.w;
  }
  vec3 sum = vec3(0.0);
  for (int k = 0; k < degree * (degree + 2); k++) {
    for (int c = 0; c < 3; c++) {
      int place = 3 * k + c;
      // Shifted to the top and back, which extends the sign.
      int value = int(words[place / 4] << uint(24 - 8 * (place % 4))) >> 24;
      sum[c] += basis[k] * float(value);
    }
  }
  return sum / 127.0;
}

vec3 covariance(vec3 p, float sigma) {
  float s = focal / p.z;
  if (!anisotropic) return vec3(s * s * sigma * sigma, 0.0, s * s * sigma * sigma);
  vec4 a = texelFetch(shapes, texel(2), 0);
  vec4 b = texelFetch(shapes, texel(2) + ivec2(1, 0), 0);
  mat3 shape = mat3(a.x, a.y, a.z, a.y, a.w, b.x, a.z, b.x, b.y);
  // The projection is linearised at the centre; far outside the image this is not valid.
  vec2 limit = 0.65 * viewport / focal;
  vec2 ray = clamp(p.xy / p.z, -limit, limit);
  mat3 inCamera = rotation * shape * transpose(rotation);
  vec3 jx = s * vec3(1.0, 0.0, -ray.x), jy = s * vec3(0.0, 1.0, -ray.y);
  vec3 sx = inCamera * jx;
  return sigma * sigma * vec3(dot(jx, sx), dot(jy, sx), dot(jy, inCamera * jy));
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside
  vec4 stored = texelFetch(positions, texel(1), 0);
  vec3 p = rotation * (stored.xyz - eye);
  if (p.z < NEAR) return;
  colour = texelFetch(colours, texel(1), 0);
  if (colour.a < 1.0 / 255.0) return;
  if (degree > 0) colour.rgb = clamp(colour.rgb + harmonicColour(normalize(stored.xyz - eye)), 0.0, 1.0);

  vec3 v = covariance(p, stored.w) + vec3(PIXEL_VARIANCE, 0.0, PIXEL_VARIANCE);
  float middle = 0.5 * (v.x + v.z);
  float reach = sqrt(max(middle * middle - (v.x * v.z - v.y * v.y), 0.0));
  float major = middle + reach, minor = max(middle - reach, 0.05);
  vec2 axis = abs(v.y) < 1e-6 ? (v.x >= v.z ? vec2(1.0, 0.0) : vec2(0.0, 1.0))
                              : normalize(vec2(v.y, major - v.x));
  float extent = min(sqrt(2.0 * log(255.0 * colour.a)), 3.33);
  place = extent * corner;
  vec2 pixels = place.x * sqrt(major) * axis + place.y * sqrt(minor) * vec2(-axis.y, axis.x);
  vec2 centre = focal * p.xy / p.z;
  vec2 clip = 2.0 * (centre + pixels) / viewport;
  gl_Position = vec4(clip.x, -clip.y, 0.0, 1.0);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec4 colour;
in vec2 place;
out vec4 result;
void main() {
  float alpha = colour.a * exp(-0.5 * dot(place, place));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(colour.rgb * alpha, alpha);
}`;

// A line of some pixels width: a rectangle between both ends.
const LINE_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec2 corner;
layout(location = 1) in vec3 first;
layout(location = 2) in vec3 second;
layout(location = 3) in vec4 paint;
uniform mat3 rotation;
uniform vec3 eye;
uniform float focal;
uniform vec2 viewport;
uniform float halfWidth;  // pixels
out vec4 colour;
out float depth;
const float NEAR = ${NEAR_M.toFixed(3)};
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  vec3 a = rotation * (first - eye), b = rotation * (second - eye);
  if (a.z < NEAR && b.z < NEAR) return;
  if (a.z < NEAR) a = mix(b, a, (b.z - NEAR) / (b.z - a.z));
  if (b.z < NEAR) b = mix(a, b, (a.z - NEAR) / (a.z - b.z));
  vec2 pa = focal * a.xy / a.z, pb = focal * b.xy / b.z;
  vec2 along = pb - pa;
  along = dot(along, along) < 1e-6 ? vec2(1.0, 0.0) : normalize(along);
  vec2 side = halfWidth * vec2(-along.y, along.x);
  vec2 pixel = (corner.x < 0.0 ? pa : pb) + corner.y * side + corner.x * halfWidth * 0.5 * along;
  gl_Position = vec4(2.0 * pixel.x / viewport.x, -2.0 * pixel.y / viewport.y, 0.0, 1.0);
  colour = paint;
  depth = corner.x < 0.0 ? a.z : b.z;
}`;

const LINE_FRAGMENT = `#version 300 es
precision highp float;
in vec4 colour;
in float depth;
out vec4 result;
void main() {
  // Lines close to the viewer would cover the map.
  float alpha = colour.a * smoothstep(0.15, 1.2, depth);
  result = vec4(colour.rgb * alpha, alpha);
}`;

const programs = new Map(); // by the source of the vertex shader

/** Compile and link a program, once; throws an Error with the compiler's log. */
function buildProgram(gl, vertex, fragment) {
  if (programs.has(vertex)) return programs.get(vertex);
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(program, i);
    uniforms[name] = gl.getUniformLocation(program, name);
  }
  programs.set(vertex, { program, uniforms });
  return programs.get(vertex);
}

/** Set the uniforms that splats and lines share. */
function setView(gl, uniforms, camera) {
  const { rows, eye } = camera.view;
  gl.uniformMatrix3fv(uniforms.rotation, true, rows.flat());
  gl.uniform3fv(uniforms.eye, eye);
  gl.uniform1f(uniforms.focal, camera.focal);
  gl.uniform2f(uniforms.viewport, camera.width, camera.height);
}
