// Dense frame-to-model alignment: photometric and point-to-plane residuals (mission section 7).
//
// The point Y = T_model_frame P of a frame pixel is projected into the model view. Photometric
// residual: interpolated model intensity minus the frame's intensity. Geometric residual: distance of
// Y from the model's plane.
// Derivatives come from the model, which is smoother than a camera image. Weights follow
// Student's t distribution (STUDENT_T_DOF), whose scales the caller re-estimates from the sums.
#include "alignment/normal_equations.hpp"

#include <algorithm>
#include <cstring>
#include <vector>

#include "common/constants.hpp"
#include "common/simd.hpp"

namespace semsplat {
namespace {

enum { ROWS = 4 };  // rows per group; a group is summed in single, groups in double precision

static_assert(sizeof(NormalEquations) == ALIGNMENT_SUMS * sizeof(double), "Python allocates the sums");

// Sums of one group of rows, T is a float or a vector of them: upper triangles of the blocks of the
// Hessian.
template <class T>
struct Sums {
    T pose[21], pose_gain[6], pose_bias[6], gain_gain, gain_bias, bias_bias;
    T g[PARAMETERS];
    T intensity_squares, depth_squares;
};
constexpr float LANE_NUMBERS[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
enum { SUMS = sizeof(Sums<float>) / sizeof(float) };

struct Group {
    Sums<float> sums;
    int intensity_pixels, depth_pixels, frame_pixels;
};

// A frame's points in the model's camera, and their pixels in its image. Without a pixel there, a
// point is (0, 0, 1) at pixel (0, 0), so that what follows is finite in all lanes.
struct Points {
    Floats Y[3], inverse_z;
    Floats column, row;  // of the tap at the upper left
    Floats a, b;         // the point's distance from it
    Mask inside;
};

struct Residual {
    Floats J[6], r, weight;
};

SEMSPLAT_INLINE Floats dot(const Floats* a, const Floats* b) {
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]));
}

SEMSPLAT_INLINE void cross(const Floats* a, const Floats* b, Floats* out) {
    out[0] = fnma(a[2], b[1], a[1] * b[2]);
    out[1] = fnma(a[0], b[2], a[2] * b[0]);
    out[2] = fnma(a[1], b[0], a[0] * b[1]);
}

// The first `count` of LANES values; the others are 0.
SEMSPLAT_INLINE Floats load_some(const float* p, int count) {
    if (count == LANES) return load(p);
    float values[LANES] = {};
    std::memcpy(values, p, (size_t)count * sizeof *p);
    return load(values);
}

// Weight of a residual with variance 1 in Student's t distribution.
SEMSPLAT_INLINE Floats robust_weight(Floats squared) {
    return all(STUDENT_T_DOF + 1) * reciprocal(squared + all(STUDENT_T_DOF));
}

SEMSPLAT_INLINE void add_residuals(const Residual& plane, const Residual& image, Floats own, Sums<Floats>& sums) {
    int k = 0;
    for (int i = 0; i < 6; ++i) {
        const Floats wp = plane.weight * plane.J[i], wi = image.weight * image.J[i];
        for (int j = i; j < 6; ++j, ++k) {
            sums.pose[k] = fma(wi, image.J[j], fma(wp, plane.J[j], sums.pose[k]));
        }
        sums.g[i] = fma(wi, image.r, fma(wp, plane.r, sums.g[i]));
        sums.pose_gain[i] = fnma(wi, own, sums.pose_gain[i]);
        sums.pose_bias[i] = sums.pose_bias[i] - wi;
    }
    const Floats by_gain = image.weight * own;
    sums.gain_gain = fma(by_gain, own, sums.gain_gain);
    sums.gain_bias = sums.gain_bias + by_gain;
    sums.bias_bias = sums.bias_bias + image.weight;
    sums.g[6] = fnma(by_gain, image.r, sums.g[6]);
    sums.g[7] = fnma(image.weight, image.r, sums.g[7]);
}

class Kernel {
public:
    Kernel(const ModelLevel& m, const FrameLevel& f, const AlignmentSettings& s) : model(m), frame(f) {
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) R[3 * i + j] = (float)s.T_model_frame[4 * i + j];
            t[i] = (float)s.T_model_frame[4 * i + 3];
        }
        gain = (float)s.gain;
        bias = (float)s.bias;
        gate = (float)s.max_distance;
        photometric_weight = (float)s.photometric_weight;
        inverse_si = (float)(1.0 / s.sigma_intensity);
        inverse_sd = (float)(1.0 / s.sigma_depth);
    }

    Group accumulate(int row_begin, int row_end) const {
        const Pinhole& fc = frame.camera;
        Group group = {};
        Sums<Floats> sums;
        std::memset(&sums, 0, sizeof sums);
        for (int y = row_begin; y < row_end; ++y) {
            const float ray_y = (y - fc.cy) / fc.fy;
            for (int x = 0; x < fc.width; x += LANES) {
                const size_t at = (size_t)y * fc.width + x;
                const int count = std::min<int>(LANES, fc.width - x);
                Floats ray_x = (load(LANE_NUMBERS) + all((float)x - fc.cx)) * all(1.0f / fc.fx);
                add_pixels(load_some(frame.depth + at, count), load_some(frame.intensity + at, count), ray_x, ray_y,
                           sums, group);
            }
        }
        Floats padded[(SUMS + 7) / 8 * 8] = {};
        float lanes_added[(SUMS + 7) / 8 * 8];
        std::memcpy(padded, &sums, sizeof sums);
        for (int k = 0; k < SUMS; k += 8) sum8(padded + k, lanes_added + k);
        std::memcpy(&group.sums, lanes_added, sizeof group.sums);
        return group;
    }

private:
    const ModelLevel& model;
    const FrameLevel& frame;
    float R[9], t[3];
    float gain, bias, gate, photometric_weight, inverse_si, inverse_sd;

    SEMSPLAT_INLINE Points project(Floats z, Floats ray_x, float ray_y) const {
        const Pinhole& mc = model.camera;
        Points p;
        for (int i = 0; i < 3; ++i) {
            const Floats along = fma(all(R[3 * i]), ray_x, all(R[3 * i + 1] * ray_y + R[3 * i + 2]));
            p.Y[i] = fma(z, along, all(t[i]));
        }
        const Mask in_front = both(lt(all(0.0f), z), lt(all(NEAR_M), p.Y[2]));
        p.Y[2] = select(in_front, p.Y[2], all(1.0f));
        p.inverse_z = reciprocal(p.Y[2]);
        Floats u = fma(all(mc.fx) * p.Y[0], p.inverse_z, all(mc.cx));
        Floats v = fma(all(mc.fy) * p.Y[1], p.inverse_z, all(mc.cy));
        const Mask low = both(ge(u, all(0.0f)), ge(v, all(0.0f)));
        const Mask high = both(lt(u, all((float)(mc.width - 1))), lt(v, all((float)(mc.height - 1))));
        p.inside = both(in_front, both(low, high));
        for (int i = 0; i < 2; ++i) p.Y[i] = keep(p.inside, p.Y[i]);
        p.Y[2] = select(p.inside, p.Y[2], all(1.0f));
        p.inverse_z = select(p.inside, p.inverse_z, all(1.0f));
        u = keep(p.inside, u);
        v = keep(p.inside, v);
        p.column = truncate(u);
        p.row = truncate(v);
        p.a = u - p.column;
        p.b = v - p.row;
        return p;
    }

    // Distance from the plane of the nearest model pixel, whose depth is `seen`. Returns the squared
    // residual times its robust weight.
    SEMSPLAT_INLINE Floats geometric(const Points& p, const Floats* plane, Floats seen, Mask valid,
                                     Residual& out) const {
        out.r = dot(plane, p.Y) - plane[3];
        // The sensor's noise grows with the squared depth. Weight and Jacobian use the model's
        // depth: the frame's depth would correlate them with its noise, give nearer points
        // more weight, and bias the pose.
        const Floats least = all(MIN_NOISE_DEPTH_M * MIN_NOISE_DEPTH_M);
        const Floats scale = all(inverse_sd) * reciprocal(maximum(seen * seen, least));
        const Floats to_view = seen * p.inverse_z;
        const Floats X[3] = {p.Y[0] * to_view, p.Y[1] * to_view, seen};
        const Floats q = out.r * scale, squared = q * q;
        const Floats robust = keep(valid, robust_weight(squared));
        out.weight = robust * scale * scale;
        for (int i = 0; i < 3; ++i) out.J[i] = plane[i];
        cross(X, plane, out.J + 3);
        return robust * squared;
    }

    // Interpolated model intensity minus the frame's. Returns the squared residual times its robust
    // weight.
    SEMSPLAT_INLINE Floats photometric(const Points& p, const Floats* value, Floats own, Mask valid,
                                       Residual& out) const {
        const Pinhole& mc = model.camera;
        out.r = value[0] - fma(all(gain), own, all(bias));
        const Floats q = out.r * all(inverse_si), squared = q * q;
        const Floats robust = keep(valid, robust_weight(squared));
        out.weight = robust * all(photometric_weight * inverse_si * inverse_si);
        out.J[0] = value[1] * all(mc.fx) * p.inverse_z;
        out.J[1] = value[2] * all(mc.fy) * p.inverse_z;
        out.J[2] = (all(0.0f) - fma(out.J[0], p.Y[0], out.J[1] * p.Y[1])) * p.inverse_z;
        cross(p.Y, out.J, out.J + 3);
        return robust * squared;
    }

    // Where all taps have a depth and belong to one surface.
    SEMSPLAT_INLINE Mask usable(const int32_t* corner, const Floats (&depth)[4], Mask candidates) const {
        const Floats nearest = minimum(minimum(depth[0], depth[1]), minimum(depth[2], depth[3]));
        const Floats farthest = maximum(maximum(depth[0], depth[1]), maximum(depth[2], depth[3]));
        const Mask valid = both(candidates, lt(all(0.0f), nearest));
        const Mask edges = both(valid, lt(all(MAX_DEPTH_STEP) * nearest, farthest - nearest));
        uint32_t left = bits(edges);
        if (!left) return valid;
        // If both pairs of opposite taps are on a plane with their neighbours, all are on one surface.
        float on_surface[LANES];
        for (int i = 0; i < LANES; ++i) on_surface[i] = 1.0f;
        for (; left; left &= left - 1) {
            const int lane = __builtin_ctz(left);
            const float* plane = model.surface + 4 * (size_t)corner[lane];
            if (plane[3] == 0 || plane[4 * (model.camera.width + 1) + 3] == 0) on_surface[lane] = 0.0f;
        }
        return both(valid, lt(all(0.0f), load(on_surface)));
    }

    SEMSPLAT_INLINE void add_pixels(Floats z, Floats own, Floats ray_x, float ray_y, Sums<Floats>& sums,
                                    Group& group) const {
        const Points p = project(z, ray_x, ray_y);
        if (!bits(p.inside)) return;
        group.frame_pixels += __builtin_popcount(bits(p.inside));

        const int width = model.camera.width;
        const Mask right = ge(p.a, all(0.5f)), below = ge(p.b, all(0.5f));
        float column[LANES], row[LANES], nearest_column[LANES], nearest_row[LANES];
        store(column, p.column);
        store(row, p.row);
        store(nearest_column, p.column + keep(right, all(1.0f)));
        store(nearest_row, p.row + keep(below, all(1.0f)));
        int32_t corner[LANES], lower[LANES], nearest[LANES];
        for (int i = 0; i < LANES; ++i) {
            corner[i] = (int32_t)row[i] * width + (int32_t)column[i];
            lower[i] = corner[i] + width;
            nearest[i] = (int32_t)nearest_row[i] * width + (int32_t)nearest_column[i];
        }
        Floats taps[4][4];  // [tap][intensity, two derivatives, depth]
        gather4(model.texture, corner, taps[0]);
        gather4(model.texture + 4, corner, taps[1]);
        gather4(model.texture, lower, taps[2]);
        gather4(model.texture + 4, lower, taps[3]);
        const Floats depth[4] = {taps[0][3], taps[1][3], taps[2][3], taps[3][3]};
        const Floats seen = select(below, select(right, depth[3], depth[2]), select(right, depth[1], depth[0]));
        const Mask close = both(both(p.inside, lt(all(0.0f), seen)),
                                both(lt(seen - p.Y[2], all(gate) * seen), lt(p.Y[2] - seen, all(gate) * seen)));
        if (!bits(close)) return;

        Floats plane[4];
        gather4(model.surface, nearest, plane);
        const Mask has_plane = both(close, lt(all(0.0f), dot(plane, plane)));
        const Mask textured = usable(corner, depth, close);
        Residual surface, image;
        sums.depth_squares = sums.depth_squares + geometric(p, plane, seen, has_plane, surface);
        group.depth_pixels += __builtin_popcount(bits(has_plane));

        const Floats wb[2] = {all(1.0f) - p.b, p.b}, wa[2] = {all(1.0f) - p.a, p.a};
        Floats value[3];
        for (int k = 0; k < 3; ++k) {
            const Floats top = fma(wa[1], taps[1][k], wa[0] * taps[0][k]);
            const Floats bottom = fma(wa[1], taps[3][k], wa[0] * taps[2][k]);
            value[k] = fma(wb[1], bottom, wb[0] * top);
        }
        sums.intensity_squares = sums.intensity_squares + photometric(p, value, own, textured, image);
        group.intensity_pixels += __builtin_popcount(bits(textured));
        add_residuals(surface, image, own, sums);
    }
};

void add(const Group& group, NormalEquations& out) {
    const Sums<float>& s = group.sums;
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
    out.intensity_pixels += group.intensity_pixels;
    out.depth_pixels += group.depth_pixels;
    out.intensity_squares += s.intensity_squares;
    out.depth_squares += s.depth_squares;
    out.frame_pixels += group.frame_pixels;
}

}  // namespace

void accumulate(const ModelLevel& model, const FrameLevel& frame, const AlignmentSettings& settings,
                NormalEquations& out) {
    const int height = frame.camera.height, groups = (height + ROWS - 1) / ROWS;
    const Kernel kernel(model, frame, settings);
    std::vector<Group> sums((size_t)groups);
#pragma omp parallel for schedule(dynamic, 2)
    for (int group = 0; group < groups; ++group) {
        sums[(size_t)group] = kernel.accumulate(group * ROWS, std::min(height, (group + 1) * ROWS));
    }
    std::memset(&out, 0, sizeof out);
    for (const Group& group : sums) add(group, out);
}

}  // namespace semsplat
