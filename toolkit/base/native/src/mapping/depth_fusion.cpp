#include "mapping/depth_fusion.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace semsplat {
namespace {

// Depth measured at an image point between four pixels; 0 if they do not belong to one surface.
// Interpolates inverse depth, which is linear on a plane.
float surface_depth(const MeasuringView& view, float u, float v, float max_edge) {
    const int column = (int)u, row = (int)v, width = view.camera.width;
    const float right = u - (float)column, down = v - (float)row;
    const float* first = view.depth + (size_t)row * width + column;
    const float depths[4] = {first[0], first[1], first[width], first[width + 1]};
    const float weights[4] = {(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right};
    float low = HUGE_VALF, high = 0, sum = 0;
    for (int i = 0; i < 4; ++i) {
        if (!(depths[i] > 0)) return 0;
        const float inverse = 1 / std::max(depths[i], 1e-6f);
        low = std::min(low, inverse);
        high = std::max(high, inverse);
        sum += weights[i] * inverse;
    }
    return high - low < max_edge * high ? 1 / std::max(sum, 1e-6f) : 0;
}

float length(float x, float y, float z) { return std::sqrt(x * x + y * y + z * z); }

}  // namespace

void fuse_depth(float* centres, int32_t* seeded_by, int64_t count, const MeasuringView& view,
                const SeedingKeyframes& keyframes, const FusionLimits& limits) {
    const Pinhole& camera = view.camera;
    const float* T = view.T_camera_map;
    const int32_t newest = keyframes.indices[keyframes.count - 1];
#pragma omp parallel for schedule(static) if (count > 4096)
    for (int64_t i = 0; i < count; ++i) {
        float* m = centres + 3 * i;
        const float z = T[8] * m[0] + T[9] * m[1] + T[10] * m[2] + T[11];
        if (!(z > limits.min_depth)) continue;
        const float x = T[0] * m[0] + T[1] * m[1] + T[2] * m[2] + T[3];
        const float y = T[4] * m[0] + T[5] * m[1] + T[6] * m[2] + T[7];
        const float u = camera.fx * x / z + camera.cx, v = camera.fy * y / z + camera.cy;
        if (!(u >= 0 && v >= 0 && u < (float)(camera.width - 1) && v < (float)(camera.height - 1))) continue;
        const float depth = surface_depth(view, u, v, limits.edge);
        if (!(depth > 0)) continue;

        const int32_t* end = keyframes.indices + keyframes.count;
        const int64_t place = std::lower_bound(keyframes.indices, end, seeded_by[i]) - keyframes.indices;
        const float* from = keyframes.positions + 3 * std::min(place, keyframes.count - 1);
        const float previous = length(m[0] - from[0], m[1] - from[1], m[2] - from[2]);
        const float ratio = previous / std::max(length(x, y, z), limits.min_depth);
        const float weight = std::min(limits.weight * ratio * ratio * ratio * ratio, 1.0f);
        const float farthest = std::max(previous, depth);
        const float noise = limits.max_inverse_distance * farthest * farthest;
        const bool on_surface = std::abs(depth - z) < std::min(noise, limits.max_distance * depth);
        if (!(weight > limits.min_weight && on_surface)) continue;

        const float scale = 1 + weight * (depth / z - 1);
        for (int k = 0; k < 3; ++k) m[k] = view.position[k] + scale * (m[k] - view.position[k]);
        if (weight >= 1) seeded_by[i] = newest;
    }
}

}  // namespace semsplat
