// Dense frame-to-model alignment: photometric and point-to-plane residuals (mission section 7).
//
// The point Y = T_model_frame P of a frame pixel is projected into the model view. Photometric
// residual: interpolated model intensity minus the frame's intensity. Geometric residual: distance of
// Y from the model's plane.
// Derivatives come from the model, which is smoother than a camera image. Weights follow
// Student's t distribution (STUDENT_T_DOF), whose scales the caller re-estimates from the sums.
#include "alignment/normal_equations.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "common/constants.hpp"

namespace semsplat {
namespace {

enum { ROWS = 4 };  // rows per group; a group is summed in single, groups in double precision

static_assert(sizeof(NormalEquations) == ALIGNMENT_SUMS * sizeof(double), "Python allocates the sums");

// Sums of one group of rows: upper triangles of the two blocks of the Hessian.
struct Sums {
    float pose[21], pose_gain[6], pose_bias[6], gain_gain, gain_bias, bias_bias;
    float g[PARAMETERS];
    float intensity_pixels, depth_pixels, intensity_squares, depth_squares, frame_pixels;
};

inline void add_outer(Sums& s, const float* J, float weight, float residual) {
    int k = 0;
    for (int i = 0; i < 6; ++i) {
        const float wj = weight * J[i];
        for (int j = i; j < 6; ++j) s.pose[k++] += wj * J[j];
        s.g[i] += wj * residual;
    }
}

// Bilinear intensity, derivatives and depth; false if a tap is invalid or the taps cross an edge.
inline bool look_up(const ModelLevel& model, float u, float v, float* value) {
    const int x = (int)u, y = (int)v, W = model.camera.width;
    const float a = u - x, b = v - y;
    const float* p00 = model.texture + 4 * ((size_t)y * W + x);
    const float* p01 = p00 + 4;
    const float* p10 = p00 + 4 * W;
    const float* p11 = p10 + 4;
    const float nearest = std::min(std::min(p00[3], p01[3]), std::min(p10[3], p11[3]));
    const float farthest = std::max(std::max(p00[3], p01[3]), std::max(p10[3], p11[3]));
    if (!(nearest > 0)) return false;
    if (farthest - nearest > MAX_DEPTH_STEP * nearest) {
        // If both pairs of opposite taps are on a plane with their neighbours, all are on one surface.
        const float* plane = model.surface + 4 * ((size_t)y * W + x);
        if (plane[3] == 0 || plane[4 * (W + 1) + 3] == 0) return false;
    }
    const float w00 = (1 - a) * (1 - b), w01 = a * (1 - b), w10 = (1 - a) * b, w11 = a * b;
    for (int k = 0; k < 4; ++k) value[k] = w00 * p00[k] + w01 * p01[k] + w10 * p10[k] + w11 * p11[k];
    return true;
}

void accumulate_rows(const ModelLevel& model, const FrameLevel& frame, const AlignmentSettings& s,
                     const float* R, const float* t, int row_begin, int row_end, Sums& sums) {
    const Pinhole& fc = frame.camera;
    const Pinhole& mc = model.camera;
    const float gain = (float)s.gain, bias = (float)s.bias, gate = (float)s.max_distance;
    const float photometric_weight = (float)s.photometric_weight;
    const float inverse_si = (float)(1.0 / s.sigma_intensity), inverse_sd = (float)(1.0 / s.sigma_depth);
    for (int py = row_begin; py < row_end; ++py) {
        const float ray_y = (py - fc.cy) / fc.fy;
        for (int px = 0; px < fc.width; ++px) {
            const size_t at = (size_t)py * fc.width + px;
            const float z = frame.depth[at];
            if (!(z > 0)) continue;
            const float ray_x = (px - fc.cx) / fc.fx;
            const float Y[3] = {z * (R[0] * ray_x + R[1] * ray_y + R[2]) + t[0],
                                z * (R[3] * ray_x + R[4] * ray_y + R[5]) + t[1],
                                z * (R[6] * ray_x + R[7] * ray_y + R[8]) + t[2]};
            if (!(Y[2] > NEAR_M)) continue;
            const float inverse_z = 1.0f / Y[2];
            const float u = mc.fx * Y[0] * inverse_z + mc.cx, v = mc.fy * Y[1] * inverse_z + mc.cy;
            if (!(u >= 0 && v >= 0 && u < mc.width - 1 && v < mc.height - 1)) continue;
            sums.frame_pixels += 1;

            // Geometric term: plane of the nearest model pixel.
            const float* plane = model.surface + 4 * ((size_t)(v + 0.5f) * mc.width + (size_t)(u + 0.5f));
            const float* texel = model.texture + 4 * ((size_t)(v + 0.5f) * mc.width + (size_t)(u + 0.5f));
            const float seen = texel[3];
            if (!(seen > 0 && std::fabs(seen - Y[2]) < gate * seen)) continue;
            float J[6];
            if (plane[0] != 0 || plane[1] != 0 || plane[2] != 0) {
                const float* n = plane;
                const float r = n[0] * Y[0] + n[1] * Y[1] + n[2] * Y[2] - plane[3];
                // The sensor's noise grows with the squared depth. Weight and Jacobian use the model's
                // depth: the frame's depth would correlate them with its noise, give nearer points
                // more weight, and bias the pose.
                const float scale = inverse_sd / std::max(seen * seen, MIN_NOISE_DEPTH_M * MIN_NOISE_DEPTH_M);
                const float to_view = seen * inverse_z;
                const float X[3] = {Y[0] * to_view, Y[1] * to_view, seen};
                const float q = r * scale;
                const float robust = (STUDENT_T_DOF + 1) / (STUDENT_T_DOF + q * q);
                const float weight = robust * scale * scale;
                J[0] = n[0];
                J[1] = n[1];
                J[2] = n[2];
                J[3] = X[1] * n[2] - X[2] * n[1];
                J[4] = X[2] * n[0] - X[0] * n[2];
                J[5] = X[0] * n[1] - X[1] * n[0];
                add_outer(sums, J, weight, r);
                sums.depth_pixels += 1;
                sums.depth_squares += robust * q * q;
            }

            float value[4];
            if (!look_up(model, u, v, value)) continue;
            const float own = frame.intensity[at];
            const float r = value[0] - (gain * own + bias);
            const float q = r * inverse_si;
            const float robust = (STUDENT_T_DOF + 1) / (STUDENT_T_DOF + q * q);
            const float weight = photometric_weight * robust * inverse_si * inverse_si;
            const float a = value[1] * mc.fx * inverse_z, b = value[2] * mc.fy * inverse_z;
            const float c = -(a * Y[0] + b * Y[1]) * inverse_z;
            J[0] = a;
            J[1] = b;
            J[2] = c;
            J[3] = Y[1] * c - Y[2] * b;
            J[4] = Y[2] * a - Y[0] * c;
            J[5] = Y[0] * b - Y[1] * a;
            add_outer(sums, J, weight, r);
            for (int k = 0; k < 6; ++k) {
                sums.pose_gain[k] -= weight * J[k] * own;
                sums.pose_bias[k] -= weight * J[k];
            }
            sums.gain_gain += weight * own * own;
            sums.gain_bias += weight * own;
            sums.bias_bias += weight;
            sums.g[6] -= weight * own * r;
            sums.g[7] -= weight * r;
            sums.intensity_pixels += 1;
            sums.intensity_squares += robust * q * q;
        }
    }
}

void add(const Sums& s, NormalEquations& out) {
    int from = 0;
    for (int i = 0; i < 6; ++i) {
        // Start of row i of the 8x8 upper triangle.
        double* row = out.H + i * PARAMETERS - i * (i - 1) / 2;
        for (int j = i; j < 6; ++j) row[j - i] += s.pose[from++];
        row[6 - i] += s.pose_gain[i];
        row[7 - i] += s.pose_bias[i];
    }
    out.H[33] += s.gain_gain;
    out.H[34] += s.gain_bias;
    out.H[35] += s.bias_bias;
    for (int k = 0; k < PARAMETERS; ++k) out.g[k] += s.g[k];
    out.intensity_pixels += s.intensity_pixels;
    out.depth_pixels += s.depth_pixels;
    out.intensity_squares += s.intensity_squares;
    out.depth_squares += s.depth_squares;
    out.frame_pixels += s.frame_pixels;
}

}  // namespace

void accumulate(const ModelLevel& model, const FrameLevel& frame, const AlignmentSettings& settings,
                NormalEquations& out) {
    const int height = frame.camera.height, groups = (height + ROWS - 1) / ROWS;
    float R[9], t[3];
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) R[3 * i + j] = (float)settings.T_model_frame[4 * i + j];
        t[i] = (float)settings.T_model_frame[4 * i + 3];
    }
    std::vector<Sums> sums((size_t)groups);
#pragma omp parallel for schedule(dynamic, 2)
    for (int group = 0; group < groups; ++group) {
        Sums local;
        std::memset(&local, 0, sizeof local);
        accumulate_rows(model, frame, settings, R, t, group * ROWS, std::min(height, (group + 1) * ROWS), local);
        sums[(size_t)group] = local;
    }
    std::memset(&out, 0, sizeof out);
    for (const Sums& s : sums) add(s, out);
}

}  // namespace semsplat
