// Ellipsoids as 3DGS renders them: the covariance Sigma = Q S S Q^T of axes S and rotation Q projects to
// M M^T with M = J R Q S, where J is the Jacobian of the projection at the centre. The depth is linear in
// the pixel: the mean depth of the Gaussian at that pixel, which lies on the plane of a flat ellipsoid.
#include <algorithm>
#include <cmath>

#include "rendering/ellipsoids.hpp"
#include "rendering/harmonics.hpp"

namespace semsplat {
namespace {

// The Jacobian is evaluated at most this far outside of the image, in half image sizes, as in 3DGS.
constexpr float MAX_SLOPE = 1.3f;

// Values of one ellipsoid in one view.
struct EllipsoidView {
    float p[3];                // centre in camera coordinates
    float u, v;                // in pixels
    float x, y;                // slopes at which the Jacobian is evaluated
    bool moves_x, moves_y;     // whether they are those of the centre
    float axes[3], Q[9], quaternion[4], length;
    float T[6];                // J R
    float QS[9];
    float M[6], Mz[3];
    float xx, xy, yy;          // covariance in squared pixels, with the low-pass
    float zx, zy;              // covariance of the depth and the pixel
    float bare, determinant;   // of the covariance without and with it
    float gain;                // factor of the opacity
};

void multiply(const float* a, const float* b, int rows, float* out) {  // [rows, 3] [3, 3]
    for (int i = 0; i < rows; ++i) {
        for (int j = 0; j < 3; ++j) {
            out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
        }
    }
}

void rotation_of(const float* q, float* Q) {
    const float w = q[0], x = q[1], y = q[2], z = q[3];
    const float values[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                             2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                             2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
    std::copy_n(values, 9, Q);
}

// The slope x / z of a centre, limited to the surroundings of the image.
float limited(float slope, float focal, float centre, int size, bool& moves) {
    const float half = 0.5f * MAX_SLOPE * (float)size / focal, middle = (0.5f * (float)(size - 1) - centre) / focal;
    const float value = std::clamp(slope, middle - half, middle + half);
    moves = value == slope;
    return value;
}

// Fills the centre; false if it is behind the camera.
bool place(const Gaussians& map, const Rasterisation& state, int64_t i, EllipsoidView& e) {
    const Pinhole& cam = state.camera;
    const float *R = state.R, *m = map.means + 3 * i;
    for (int k = 0; k < 3; ++k) e.p[k] = R[3 * k] * m[0] + R[3 * k + 1] * m[1] + R[3 * k + 2] * m[2] + state.t[k];
    if (!(e.p[2] > NEAR_M)) return false;
    const float slope_x = e.p[0] / e.p[2], slope_y = e.p[1] / e.p[2];
    e.u = cam.fx * slope_x + cam.cx;
    e.v = cam.fy * slope_y + cam.cy;
    e.x = limited(slope_x, cam.fx, cam.cx, cam.width, e.moves_x);
    e.y = limited(slope_y, cam.fy, cam.cy, cam.height, e.moves_y);
    return true;
}

bool overlaps(const Pinhole& cam, const EllipsoidView& e, float across, float down) {
    return e.u + across >= 0 && e.v + down >= 0 && e.u - across <= cam.width - 1 && e.v - down <= cam.height - 1;
}

// Whether a sphere around the ellipsoid may overlap the image.
bool may_overlap(const Gaussians& map, const Rasterisation& state, int64_t i, const EllipsoidView& e) {
    const Pinhole& cam = state.camera;
    const float* log_scales = map.log_scales + 3 * i;
    const float radius = std::exp(std::max({log_scales[0], log_scales[1], log_scales[2]})) / e.p[2];
    const auto reach = [&](float focal, float slope) {
        const float sigma = focal * radius * std::sqrt(1 + slope * slope);
        return MAX_SUPPORT * std::sqrt(sigma * sigma + state.low_pass.variance);
    };
    return overlaps(cam, e, reach(cam.fx, e.x), reach(cam.fy, e.y));
}

// Fills the shape; false if it has no extent in the image.
bool shape(const Gaussians& map, const Rasterisation& state, int64_t i, EllipsoidView& e) {
    const Pinhole& cam = state.camera;
    const float inverse_z = 1.0f / e.p[2];
    const float* q = map.rotations + 4 * i;
    e.length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (!(e.length > 0)) return false;
    for (int k = 0; k < 4; ++k) e.quaternion[k] = q[k] / e.length;
    rotation_of(e.quaternion, e.Q);
    for (int k = 0; k < 3; ++k) e.axes[k] = std::exp(map.log_scales[3 * i + k]);
    const float J[6] = {cam.fx * inverse_z, 0, -cam.fx * e.x * inverse_z,
                        0, cam.fy * inverse_z, -cam.fy * e.y * inverse_z};
    multiply(J, state.R, 2, e.T);
    for (int k = 0; k < 9; ++k) e.QS[k] = e.Q[k] * e.axes[k % 3];
    multiply(e.T, e.QS, 2, e.M);
    multiply(state.R + 6, e.QS, 1, e.Mz);
    const float *m = e.M, *n = e.M + 3, s = state.low_pass.variance;
    // The determinant of M M^T as a sum of squares, which does not cancel for thin ellipses.
    const float a = m[1] * n[2] - m[2] * n[1], b = m[2] * n[0] - m[0] * n[2], c = m[0] * n[1] - m[1] * n[0];
    const float xx = m[0] * m[0] + m[1] * m[1] + m[2] * m[2], yy = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
    e.bare = a * a + b * b + c * c;
    e.determinant = e.bare + s * (xx + yy + s);
    e.xx = xx + s;
    e.yy = yy + s;
    e.xy = m[0] * n[0] + m[1] * n[1] + m[2] * n[2];
    e.zx = m[0] * e.Mz[0] + m[1] * e.Mz[1] + m[2] * e.Mz[2];
    e.zy = n[0] * e.Mz[0] + n[1] * e.Mz[1] + n[2] * e.Mz[2];
    e.gain = state.low_pass.compensated && s > 0 ? std::sqrt(e.bare / e.determinant) : 1.0f;
    return e.determinant > MIN_SIGMA_PX * MIN_SIGMA_PX * (e.xx + e.yy) && e.determinant < 1e30f;
}

// From the camera to the centre, in the map's frame; returns its length.
float direction_of(const Gaussians& map, const Rasterisation& state, int64_t i, float* direction) {
    const float *R = state.R, *t = state.t;
    float squared = 0;
    for (int k = 0; k < 3; ++k) {
        direction[k] = map.means[3 * i + k] + R[k] * t[0] + R[3 + k] * t[1] + R[6 + k] * t[2];
        squared += direction[k] * direction[k];
    }
    const float length = std::sqrt(squared);
    for (int k = 0; k < 3; ++k) direction[k] /= length;
    return length;
}

}  // namespace

bool project_ellipsoid(const Gaussians& map, const Rasterisation& state, int64_t i, Splat& splat, Slope& slope) {
    const Pinhole& cam = state.camera;
    EllipsoidView e;
    if (!place(map, state, i, e) || !may_overlap(map, state, i, e) || !shape(map, state, i, e)) return false;
    const float opacity = e.gain / (1.0f + std::exp(-map.opacity_logits[i]));
    if (!(opacity > MIN_ALPHA)) return false;
    // Slightly too large, so that rounding never removes a pixel that passes the alpha test.
    const float support = std::log(opacity / MIN_ALPHA) * 1.0001f + 1e-4f;
    const float across = std::sqrt(2.0f * support * e.xx), down = std::sqrt(2.0f * support * e.yy);
    if (!overlaps(cam, e, across, down)) return false;
    const int x0 = std::max(0, (int)std::ceil(std::max(e.u - across, -1.0f)));
    const int y0 = std::max(0, (int)std::ceil(std::max(e.v - down, -1.0f)));
    const int x1 = (int)std::floor(std::min(e.u + across, cam.width - 1.0f));
    const int y1 = (int)std::floor(std::min(e.v + down, cam.height - 1.0f));
    if (x0 > x1 || y0 > y1) return false;  // between pixel centres
    splat.u = e.u;
    splat.v = e.v;
    splat.z = e.p[2];
    // A factor of half the inverse covariance.
    splat.shape_a = std::sqrt(0.5f * e.yy / e.determinant);
    splat.shape_b = -e.xy * std::sqrt(0.5f / (e.yy * e.determinant));
    splat.shape_c = std::sqrt(0.5f / e.yy);
    splat.opacity = opacity;
    splat.support = support;
    slope.along_s = 2 * (splat.shape_a * e.zx + splat.shape_b * e.zy);
    slope.along_t = 2 * splat.shape_c * e.zy;
    float direction[3], basis[MAX_HARMONICS], colour[3];
    direction_of(map, state, i, direction);
    harmonics(map.harmonic_count, direction, basis);
    for (int c = 0; c < 3; ++c) {
        float value = map.colours[3 * i + c];
        for (int k = 0; k < map.harmonic_count; ++k) {
            value += basis[k] * map.harmonics[3 * (map.harmonic_count * i + k) + c];
        }
        colour[c] = std::max(value, 0.0f);
    }
    splat.r = colour[0];
    splat.g = colour[1];
    splat.b = colour[2];
    splat.id = (int32_t)i;
    splat.tile_x0 = (int16_t)(x0 / TILE);
    splat.tile_y0 = (int16_t)(y0 / TILE);
    splat.tile_x1 = (int16_t)(x1 / TILE);
    splat.tile_y1 = (int16_t)(y1 / TILE);
    return true;
}

namespace {

// Adds the outer product of a gradient in camera coordinates with a point of the map.
void add_pose(const float* gradient, const float* point, double* pose) {
    for (int row = 0; row < 3; ++row) {
        for (int k = 0; k < 3; ++k) pose[4 * row + k] += (double)gradient[row] * point[k];
        pose[4 * row + 3] += gradient[row];
    }
}

// Gradients of the colour's coefficients; returns in `g` the derivative for the centre in the map.
void differentiate_colour(const Gaussians& map, const Rasterisation& state, int64_t i, int64_t id,
                          const float* sums, const GradientSinks& out, float* g, double* pose) {
    const Splat& splat = state.splats[(size_t)i];
    const int K = map.harmonic_count;
    const float shown[3] = {splat.r, splat.g, splat.b};
    float by_colour[3];
    for (int c = 0; c < 3; ++c) by_colour[c] = shown[c] > 0 ? sums[GRAD_R + c] : 0.0f;
    if (out.colours) std::copy_n(by_colour, 3, out.colours + 3 * i);
    std::fill_n(g, 3, 0.0f);
    if (!K) return;
    float direction[3], basis[MAX_HARMONICS], weights[MAX_HARMONICS], by_direction[3];
    const float length = direction_of(map, state, id, direction);
    harmonics(K, direction, basis);
    for (int k = 0; k < K; ++k) {
        const float* coefficients = map.harmonics + 3 * (K * id + k);
        weights[k] = 0;
        for (int c = 0; c < 3; ++c) {
            weights[k] += by_colour[c] * coefficients[c];
            out.harmonics[3 * (K * i + k) + c] = by_colour[c] * basis[k];
        }
    }
    harmonics_gradient(K, direction, weights, by_direction);
    float along = 0;
    for (int k = 0; k < 3; ++k) along += by_direction[k] * direction[k];
    for (int k = 0; k < 3; ++k) g[k] = (by_direction[k] - along * direction[k]) / length;
    for (int row = 0; row < 3; ++row) {  // the camera's centre is -R^T t
        for (int k = 0; k < 3; ++k) {
            pose[4 * row + k] += (double)state.t[row] * g[k];
            pose[4 * row + 3] += (double)state.R[3 * row + k] * g[k];
        }
    }
}

// Gradient of a quaternion of any length from that of its rotation matrix.
void differentiate_rotation(const EllipsoidView& e, const float* D, float* out) {
    const float w = e.quaternion[0], x = e.quaternion[1], y = e.quaternion[2], z = e.quaternion[3];
    const float g[4] = {
        2 * (x * (D[7] - D[5]) + y * (D[2] - D[6]) + z * (D[3] - D[1])),
        2 * (y * (D[1] + D[3]) + z * (D[2] + D[6]) + w * (D[7] - D[5]) - 2 * x * (D[4] + D[8])),
        2 * (x * (D[1] + D[3]) + z * (D[5] + D[7]) + w * (D[2] - D[6]) - 2 * y * (D[0] + D[8])),
        2 * (x * (D[2] + D[6]) + y * (D[5] + D[7]) + w * (D[3] - D[1]) - 2 * z * (D[0] + D[4])),
    };
    float along = 0;
    for (int k = 0; k < 4; ++k) along += g[k] * e.quaternion[k];
    for (int k = 0; k < 4; ++k) out[k] = (g[k] - along * e.quaternion[k]) / e.length;
}

}  // namespace

void differentiate_ellipsoid(const Gaussians& map, const Rasterisation& state, int64_t i, const float* sums,
                             const GradientSinks& out, double* pose) {
    const Splat& splat = state.splats[(size_t)i];
    const Pinhole& cam = state.camera;
    const int64_t id = splat.id;
    EllipsoidView e;
    place(map, state, id, e);
    shape(map, state, id, e);
    const float inverse_z = 1.0f / e.p[2], slope_x = e.p[0] * inverse_z, slope_y = e.p[1] * inverse_z;

    // Half the inverse covariance is F^T F, and the exponent -|F d|^2. With the moments W of F d,
    // dL/dCovariance = 2 F^T W F, hence dL/dM = 4 F^T W (F M), where nothing large cancels.
    const float F0 = splat.shape_a, F1 = splat.shape_b, F2 = splat.shape_c;
    float gu = 2 * F0 * sums[E_S], gv = 2 * (F1 * sums[E_S] + F2 * sums[E_T]);
    // The depth is z + q d with q = C c, the inverse covariance C and c = M Mz^T; y = dL/dc.
    const Slope& slope = state.slopes[(size_t)i];
    const float qx = F0 * slope.along_s, qy = F1 * slope.along_s + F2 * slope.along_t;
    const float yx = 2 * F0 * sums[MIXED + Z_S], yy = 2 * (F1 * sums[MIXED + Z_S] + F2 * sums[MIXED + Z_T]);
    gu -= qx * sums[GRAD_Z];
    gv -= qy * sums[GRAD_Z];
    const float W0 = 4 * sums[E_S_S], W1 = 4 * sums[MIXED + E_S_T], W2 = 4 * sums[MIXED + E_T_T];
    // The low-pass: half of d log(bare / det), where det = bare + s (xx + yy) + const.
    const bool compensated = state.low_pass.compensated && state.low_pass.variance > 0;
    const float by_bare = compensated ? 0.5f * sums[E] * (1.0f / e.bare - 1.0f / e.determinant) : 0.0f;
    const float by_trace = compensated ? -0.5f * sums[E] * state.low_pass.variance / e.determinant : 0.0f;
    const float bare_xx = e.xx - state.low_pass.variance, bare_yy = e.yy - state.low_pass.variance;
    const float *m = e.M, *n = e.M + 3;
    float by_M[6], by_Mz[3];
    for (int k = 0; k < 3; ++k) {
        const float q_M = qx * m[k] + qy * n[k], y_M = yx * m[k] + yy * n[k];
        const float s = F0 * m[k] + F1 * n[k], t = F2 * n[k];
        const float by_s = W0 * s + W1 * t, by_t = W1 * s + W2 * t;
        // bare = xx yy - xy^2 of the covariance without low-pass.
        const float own_m = 2 * ((by_trace + by_bare * bare_yy) * m[k] - by_bare * e.xy * n[k]);
        const float own_n = 2 * ((by_trace + by_bare * bare_xx) * n[k] - by_bare * e.xy * m[k]);
        by_M[k] = F0 * by_s + own_m + yx * (e.Mz[k] - q_M) - qx * y_M;
        by_M[3 + k] = F1 * by_s + F2 * by_t + own_n + yy * (e.Mz[k] - q_M) - qy * y_M;
        by_Mz[k] = y_M;
        out.log_scales[3 * i + k] =
            by_s * s + by_t * t + own_m * m[k] + own_n * n[k] + 2 * y_M * (e.Mz[k] - q_M);
    }
    float by_T[6], by_QS[9], by_Q[9];
    for (int row = 0; row < 2; ++row) {
        for (int j = 0; j < 3; ++j) {
            const float *g = by_M + 3 * row, *w = e.QS + 3 * j;
            by_T[3 * row + j] = g[0] * w[0] + g[1] * w[1] + g[2] * w[2];
        }
    }
    for (int j = 0; j < 3; ++j) {
        for (int k = 0; k < 3; ++k) {
            by_QS[3 * j + k] = e.T[j] * by_M[k] + e.T[3 + j] * by_M[3 + k] + state.R[6 + j] * by_Mz[k];
            pose[8 + j] += (double)by_Mz[k] * e.QS[3 * j + k];
        }
    }
    for (int k = 0; k < 9; ++k) by_Q[k] = by_QS[k] * e.axes[k % 3];
    differentiate_rotation(e, by_Q, out.rotations + 4 * i);
    out.opacity_logits[i] = sums[E] * (1.0f - splat.opacity / e.gain);

    // T = J R, where J has the entries f / z and -f slope / z.
    float by_J[6];
    for (int row = 0; row < 2; ++row) {
        for (int j = 0; j < 3; ++j) {
            const float* R = state.R + 3 * j;
            by_J[3 * row + j] = by_T[3 * row] * R[0] + by_T[3 * row + 1] * R[1] + by_T[3 * row + 2] * R[2];
        }
    }
    const float fx = cam.fx * inverse_z, fy = cam.fy * inverse_z;
    const float J[6] = {fx, 0, -fx * e.x, 0, fy, -fy * e.y};
    for (int j = 0; j < 3; ++j) {
        for (int k = 0; k < 3; ++k) pose[4 * j + k] += (double)J[j] * by_T[k] + (double)J[3 + j] * by_T[3 + k];
    }
    const float by_x = -fx * by_J[2], by_y = -fy * by_J[5];  // of the slopes
    float g[3] = {gu * fx, gv * fy, sums[GRAD_Z]};
    g[2] -= (gu * cam.fx * slope_x + gv * cam.fy * slope_y) * inverse_z;
    g[2] -= (by_J[0] * J[0] + by_J[2] * J[2] + by_J[4] * J[4] + by_J[5] * J[5]) * inverse_z;
    if (e.moves_x) {
        g[0] += by_x * inverse_z;
        g[2] -= by_x * slope_x * inverse_z;
    }
    if (e.moves_y) {
        g[1] += by_y * inverse_z;
        g[2] -= by_y * slope_y * inverse_z;
    }
    float by_centre[3];
    differentiate_colour(map, state, i, id, sums, out, by_centre, pose);
    for (int k = 0; k < 3; ++k) {
        out.means[3 * i + k] = state.R[k] * g[0] + state.R[3 + k] * g[1] + state.R[6 + k] * g[2] + by_centre[k];
    }
    add_pose(g, map.means + 3 * id, pose);
}

}  // namespace semsplat
