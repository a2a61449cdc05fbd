#include "mapping/free_space.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace semsplat {
namespace {

// Points that are projected together.
enum { BLOCK = 256 };

struct Projections {
    float u[BLOCK], v[BLOCK], z[BLOCK];
};

// Image coordinates with pixel borders, not centres, at integers.
void project_block(const float* points, int count, const DepthView& view, Projections& out) {
    const float* T = view.T_camera_points;
    const Pinhole& camera = view.camera;
    const float cx = camera.cx + 0.5f, cy = camera.cy + 0.5f;
#pragma omp simd
    for (int i = 0; i < count; ++i) {
        const float a = points[3 * i], b = points[3 * i + 1], c = points[3 * i + 2];
        const float z = a * T[8] + b * T[9] + c * T[10] + T[11];
        const float inverse = 1.0f / std::max(z, view.min_depth);
        out.u[i] = (a * T[0] + b * T[1] + c * T[2] + T[3]) * inverse * camera.fx + cx;
        out.v[i] = (a * T[4] + b * T[5] + c * T[6] + T[7]) * inverse * camera.fy + cy;
        out.z[i] = z;
    }
}

// Calls visit(index of the point, pixel, depth) for each point in the image. Blocks run in parallel.
template <class Visit>
void for_each_visible(const float* points, int64_t count, const DepthView& view, const Visit& visit) {
    const int64_t blocks = (count + BLOCK - 1) / BLOCK;
    const float width = (float)view.camera.width, height = (float)view.camera.height;
#pragma omp parallel for schedule(static) if (blocks > 8)
    for (int64_t block = 0; block < blocks; ++block) {
        const int64_t first = block * BLOCK;
        const int size = (int)std::min<int64_t>(BLOCK, count - first);
        Projections p;
        project_block(points + 3 * first, size, view, p);
        for (int i = 0; i < size; ++i) {
            const bool inside = (p.z[i] > view.min_depth) & (p.u[i] >= 0) & (p.v[i] >= 0) & (p.u[i] < width) &
                                (p.v[i] < height);
            if (inside) visit(first + i, (size_t)p.v[i] * view.camera.width + (size_t)p.u[i], p.z[i]);
        }
    }
}

}  // namespace

void add_evidence(const float* points, int64_t count, const DepthView& view, const MeasuredDepth& measured,
                  bool weighted, const EvidenceSums& sums) {
    const auto on_surface = [&](float depth, float z) {
        const float margin = std::max(measured.margin, measured.margin_fraction * depth);
        return depth > 0 && std::abs(z - depth) <= margin;
    };
    float reliability = 1.0f;
    if (weighted) {
        std::vector<uint8_t> near(count), through(count);
        for_each_visible(points, count, view, [&](int64_t i, size_t pixel, float z) {
            near[i] = on_surface(measured.depth[pixel], z);
            through[i] = z < view.empty[pixel];
        });
        int64_t agreeing = 0, contradicting = 0;
        for (int64_t i = 0; i < count; ++i) {
            agreeing += near[i];
            contradicting += through[i];
        }
        const double share = (double)agreeing / std::max<int64_t>(agreeing + contradicting, 1);
        reliability = (float)(share * share);
    }
    for_each_visible(points, count, view, [&](int64_t i, size_t pixel, float z) {
        if (z < view.empty[pixel]) sums.through[i] += reliability * measured.confidence[pixel];
        if (on_surface(measured.depth[pixel], z)) sums.support[i] += 1.0f;
        sums.nearest[i] = std::min(sums.nearest[i], z);
    });
}

void mark_empty(const float* points, int64_t count, const DepthView& view, uint8_t* marks) {
    std::fill_n(marks, count, (uint8_t)0);
    for_each_visible(points, count, view,
                     [&](int64_t i, size_t pixel, float z) { marks[i] = z < view.empty[pixel]; });
}

}  // namespace semsplat
