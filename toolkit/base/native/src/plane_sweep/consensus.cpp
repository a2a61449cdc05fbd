#include "plane_sweep/consensus.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace semsplat {
namespace {

constexpr float MIN_DEPTH = 1e-6f;  // in front of another camera

// Where another image sees a ray of the reference image at a depth d: d * direction + centre.
struct View {
    const float* inverse_depth;
    float R[9], t[3];

    explicit View(const DepthImage& image) : inverse_depth(image.inverse_depth) {
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) R[3 * i + j] = (float)image.T_other_reference[4 * i + j];
            t[i] = (float)image.T_other_reference[4 * i + 3];
        }
    }
};

struct Sums {
    float inverse_depth, deviation, squares;  // the latter two relative to the reference image's
    float squared_parallax;
    int agreeing, conflicting;
};

// Inverse depth of an image at a position inside it: interpolated on a surface, else that of the nearest
// pixel.
float inverse_depth_at(const Pinhole& c, const float* image, float u, float v, float tolerance) {
    const int left = std::min((int)u, c.width - 2), top = std::min((int)v, c.height - 2);
    const float* p = image + (size_t)top * c.width + left;
    const float a = u - (float)left, b = v - (float)top;
    const float least = std::min(std::min(p[0], p[1]), std::min(p[c.width], p[c.width + 1]));
    const float most = std::max(std::max(p[0], p[1]), std::max(p[c.width], p[c.width + 1]));
    if (least > 0 && most - least < 2 * tolerance * most) {
        const float upper = p[0] + a * (p[1] - p[0]), lower = p[c.width] + a * (p[c.width + 1] - p[c.width]);
        return upper + b * (lower - upper);
    }
    return p[(b < 0.5f ? 0 : c.width) + (a < 0.5f ? 0 : 1)];
}

// Points are scaled by q, and depths compared by their reciprocals, to save divisions.
void compare(const ConsensusInput& in, const View& view, const float (&ray)[3], float q, Sums& sums) {
    const Pinhole& c = in.camera;
    float direction[3], point[3];
    for (int i = 0; i < 3; ++i) {
        direction[i] = view.R[3 * i] * ray[0] + view.R[3 * i + 1] * ray[1] + view.R[3 * i + 2];
        point[i] = direction[i] + q * view.t[i];
    }
    if (!(point[2] > MIN_DEPTH * q)) return;
    const float scale = 1 / point[2], x = point[0] * scale, y = point[1] * scale, expected = q * scale;
    const float u = c.fx * x + c.cx, v = c.fy * y + c.cy;
    const float right = (float)(c.width - 1), bottom = (float)(c.height - 1);
    if (!(u > -0.5f && v > -0.5f && u < right + 0.5f && v < bottom + 0.5f)) return;
    const float du = c.fx * (view.t[0] - x * view.t[2]) * expected, dv = c.fy * (view.t[1] - y * view.t[2]) * expected;
    sums.squared_parallax = std::max(sums.squared_parallax, du * du + dv * dv);
    const float seen = inverse_depth_at(c, view.inverse_depth, std::min(std::max(u, 0.0f), right),
                                        std::min(std::max(v, 0.0f), bottom), in.tolerance);
    if (!(seen > 0)) return;
    if (expected > (1 + in.in_front) * seen) ++sums.conflicting;
    if (!(std::fabs(expected - seen) < in.tolerance * seen)) return;
    // The point of the ray at the depth that the other image sees. Its distance along the ray differs by
    // more only for rays across the direction of the other camera.
    const float deviation = direction[2] * seen / (q * (1 - view.t[2] * seen)) - 1;
    if (!(std::fabs(deviation) < 2 * in.tolerance)) return;
    sums.deviation += deviation;
    sums.squares += deviation * deviation;
    ++sums.agreeing;
}

}  // namespace

void compare_depths(const ConsensusInput& in, const Consensus& out) {
    const Pinhole& c = in.camera;
    const std::vector<View> views(in.others.begin(), in.others.end());
#pragma omp parallel for schedule(dynamic, 8)
    for (int y = 0; y < c.height; ++y) {
        for (int x = 0; x < c.width; ++x) {
            const size_t i = (size_t)y * c.width + x;
            const float q = in.inverse_depth[i];
            Sums sums{};
            if (q > 0) {
                const float ray[3] = {((float)x - c.cx) / c.fx, ((float)y - c.cy) / c.fy, 1};
                for (const View& view : views) compare(in, view, ray, q, sums);
            }
            const float share = 1 / (float)(1 + sums.agreeing), mean = sums.deviation * share;
            out.inverse_depth[i] = q > 0 ? q * (1 + mean) : 0;
            out.spread[i] = std::sqrt(std::max(sums.squares * share - mean * mean, 0.0f)) / (1 + mean);
            out.parallax[i] = std::sqrt(sums.squared_parallax);
            out.agreeing[i] = (float)sums.agreeing;
            out.conflicting[i] = (float)sums.conflicting;
        }
    }
}

}  // namespace semsplat
