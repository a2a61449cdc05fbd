// Projects the Gaussians to centres and radii in pixels, and culls invisible ones.
#include <algorithm>
#include <cmath>

#include "rendering/splats.hpp"

namespace semsplat {
namespace {

// The chunks, and therefore the order of all sums, do not depend on the number of threads.
enum { CHUNK = 4096 };

// Largest support in standard deviations, at opacity 1: sqrt(2 ln (1 / MIN_ALPHA)).
constexpr float MAX_SUPPORT = 3.3291f;

// Writes the splats of one chunk of the map; returns their number.
int project_chunk(const Gaussians& map, const Rasterisation& state, int64_t begin, int64_t end,
                  Splat* out) {
    const Pinhole& cam = state.camera;
    const float* R = state.R;
    const float* t = state.t;
    const float focal = std::sqrt(cam.fx * cam.fy);
    int count = 0;
    for (int64_t i = begin; i < end; ++i) {
        const float mx = map.means[3 * i], my = map.means[3 * i + 1], mz = map.means[3 * i + 2];
        const float z = R[6] * mx + R[7] * my + R[8] * mz + t[2];
        if (!(z > NEAR_M)) continue;
        const float inverse_z = 1.0f / z;
        const float x = R[0] * mx + R[1] * my + R[2] * mz + t[0];
        const float y = R[3] * mx + R[4] * my + R[5] * mz + t[1];
        const float u = cam.fx * x * inverse_z + cam.cx;
        const float v = cam.fy * y * inverse_z + cam.cy;
        const float sigma = focal * std::exp(map.log_radii[i]) * inverse_z;
        const float reach = MAX_SUPPORT * sigma;
        if (!(u + reach >= 0 && v + reach >= 0 && u - reach <= cam.width - 1 &&
              v - reach <= cam.height - 1)) {
            continue;
        }
        const float opacity = 1.0f / (1.0f + std::exp(-map.opacity_logits[i]));
        if (!(opacity > MIN_ALPHA) || !(sigma > MIN_SIGMA_PX)) continue;
        // Slightly too large, so that rounding never removes a pixel that passes the alpha test.
        const float support_squared =
            2.0f * sigma * sigma * std::log(opacity / MIN_ALPHA) * 1.0001f + 1e-6f;
        const float support = std::sqrt(support_squared);
        const int x0 = std::max(0, (int)std::ceil(std::max(u - support, -1.0f)));
        const int y0 = std::max(0, (int)std::ceil(std::max(v - support, -1.0f)));
        const int x1 = (int)std::floor(std::min(u + support, cam.width - 1.0f));
        const int y1 = (int)std::floor(std::min(v + support, cam.height - 1.0f));
        if (x0 > x1 || y0 > y1) continue;  // between pixel centres
        Splat& s = out[count++];
        s.u = u;
        s.v = v;
        s.z = z;
        s.sigma = sigma;
        s.exponent = -0.5f / (sigma * sigma);
        s.opacity = opacity;
        s.support_squared = support_squared;
        s.r = map.colours[3 * i];
        s.g = map.colours[3 * i + 1];
        s.b = map.colours[3 * i + 2];
        s.id = (int32_t)i;
        s.tile_x0 = (int16_t)(x0 / TILE);
        s.tile_y0 = (int16_t)(y0 / TILE);
        s.tile_x1 = (int16_t)(x1 / TILE);
        s.tile_y1 = (int16_t)(y1 / TILE);
    }
    return count;
}

}  // namespace

void project(const Gaussians& map, Rasterisation& out) {
    const int64_t chunks = (map.count + CHUNK - 1) / CHUNK;
    // Each chunk writes to its own part of a buffer of maximum size, which is then compacted. Unused
    // pages of the buffer are never allocated.
    static thread_local Buffer<Splat> loose;
    loose.resize((size_t)map.count);
    std::vector<int64_t> first((size_t)chunks + 1, 0);
    Splat* const all = loose.data();
#pragma omp parallel for schedule(dynamic, 4)
    for (int64_t c = 0; c < chunks; ++c) {
        const int64_t begin = c * CHUNK, end = std::min(map.count, begin + CHUNK);
        first[(size_t)c + 1] = project_chunk(map, out, begin, end, all + begin);
    }
    for (int64_t c = 0; c < chunks; ++c) first[(size_t)c + 1] += first[(size_t)c];
    out.splats.resize((size_t)first[(size_t)chunks]);
#pragma omp parallel for schedule(static)
    for (int64_t c = 0; c < chunks; ++c) {
        std::copy_n(all + c * CHUNK, first[(size_t)c + 1] - first[(size_t)c],
                    out.splats.data() + first[(size_t)c]);
    }
}

}  // namespace semsplat
