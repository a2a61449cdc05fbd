// Projects the Gaussians to centres and radii in pixels, and culls invisible ones.
#include <algorithm>
#include <cmath>

#include "common/simd.hpp"
#include "rendering/ellipsoids.hpp"

namespace semsplat {
namespace {

// The chunks, and therefore the order of all sums, do not depend on the number of threads.
enum { CHUNK = 4096 };

// Intermediate values of the Gaussians of a chunk, as arrays for vector instructions.
struct ChunkScratch {
    alignas(64) float radius[CHUNK];  // of all Gaussians of the chunk
    // Of the visible Gaussians, in order:
    int32_t index[CHUNK];
    float u[CHUNK], v[CHUNK], z[CHUNK], sigma[CHUNK];
    alignas(64) float logit[CHUNK], opacity[CHUNK], log_ratio[CHUNK];
};

// Finds the Gaussians whose maximum support overlaps the image; returns their number.
int find_visible(const Gaussians& map, const Rasterisation& state, int64_t begin, int count, ChunkScratch& s) {
    const Pinhole& cam = state.camera;
    const float* R = state.R;
    const float* t = state.t;
    const float focal = std::sqrt(cam.fx * cam.fy), low_pass = state.low_pass.variance;
    std::copy_n(map.log_radii + begin, count, s.radius);
    for_vectors(s.radius, count, [](Floats x) { return exponential(x); });
    int visible = 0;
    for (int k = 0; k < count; ++k) {
        const float* const m = map.means + 3 * (begin + k);
        const float z = R[6] * m[0] + R[7] * m[1] + R[8] * m[2] + t[2];
        if (!(z > NEAR_M)) continue;
        const float inverse_z = 1.0f / z;
        const float x = R[0] * m[0] + R[1] * m[1] + R[2] * m[2] + t[0];
        const float y = R[3] * m[0] + R[4] * m[1] + R[5] * m[2] + t[1];
        const float u = cam.fx * x * inverse_z + cam.cx;
        const float v = cam.fy * y * inverse_z + cam.cy;
        const float logit = map.opacity_logits[begin + k];
        float sigma = focal * s.radius[k] * inverse_z;
        if (low_pass > 0) sigma = std::sqrt(sigma * sigma + low_pass);
        const float reach = MAX_SUPPORT * sigma;
        if (!(u + reach >= 0 && v + reach >= 0 && u - reach <= cam.width - 1 && v - reach <= cam.height - 1 &&
              sigma > MIN_SIGMA_PX)) {
            continue;
        }
        if (std::isnan(logit) || std::isnan(map.log_radii[begin + k])) continue;  // exponentials are clamped
        s.index[visible] = k;
        s.u[visible] = u;
        s.v[visible] = v;
        s.z[visible] = z;
        s.sigma[visible] = sigma;
        s.logit[visible++] = logit;
    }
    return visible;
}

// Writes the splats of one chunk of the map; returns their number.
int project_chunk(const Gaussians& map, const Rasterisation& state, int64_t begin, int count,
                  ChunkScratch& s, Splat* out) {
    const Pinhole& cam = state.camera;
    const int visible = find_visible(map, state, begin, count, s);
    std::copy_n(s.logit, visible, s.opacity);
    for_vectors(s.opacity, visible, [](Floats x) { return reciprocal(all(1.0f) + exponential(all(0.0f) - x)); });
    if (state.low_pass.compensated && state.low_pass.variance > 0) {
        for (int k = 0; k < visible; ++k) {
            s.opacity[k] *= 1.0f - state.low_pass.variance / (s.sigma[k] * s.sigma[k]);
        }
    }
    std::copy_n(s.opacity, visible, s.log_ratio);
    for_vectors(s.log_ratio, visible, [](Floats x) { return logarithm(x * all(1.0f / MIN_ALPHA)); });
    int written = 0;
    for (int k = 0; k < visible; ++k) {
        const float u = s.u[k], v = s.v[k], sigma = s.sigma[k], opacity = s.opacity[k];
        if (!(opacity > MIN_ALPHA)) continue;
        // Slightly too large, so that rounding never removes a pixel that passes the alpha test.
        const float support = 2.0f * sigma * sigma * s.log_ratio[k] * 1.0001f + 1e-6f;
        const float reach = std::sqrt(support);
        const int x0 = std::max(0, (int)std::ceil(std::max(u - reach, -1.0f)));
        const int y0 = std::max(0, (int)std::ceil(std::max(v - reach, -1.0f)));
        const int x1 = (int)std::floor(std::min(u + reach, cam.width - 1.0f));
        const int y1 = (int)std::floor(std::min(v + reach, cam.height - 1.0f));
        if (x0 > x1 || y0 > y1) continue;  // between pixel centres
        const int64_t i = begin + s.index[k];
        Splat& splat = out[written++];
        splat.u = u;
        splat.v = v;
        splat.z = s.z[k];
        splat.shape_a = -0.5f / (sigma * sigma);
        splat.opacity = opacity;
        splat.support = support;
        splat.r = map.colours[3 * i];
        splat.g = map.colours[3 * i + 1];
        splat.b = map.colours[3 * i + 2];
        splat.id = (int32_t)i;
        splat.tile_x0 = (int16_t)(x0 / TILE);
        splat.tile_y0 = (int16_t)(y0 / TILE);
        splat.tile_x1 = (int16_t)(x1 / TILE);
        splat.tile_y1 = (int16_t)(y1 / TILE);
    }
    return written;
}

int project_ellipsoids(const Gaussians& map, const Rasterisation& state, int64_t begin, int count, Splat* out,
                       Slope* slopes) {
    int written = 0;
    for (int64_t i = begin; i < begin + count; ++i) {
        written += project_ellipsoid(map, state, i, out[written], slopes[written]);
    }
    return written;
}

}  // namespace

void project(const Gaussians& map, Rasterisation& out) {
    const int64_t chunks = (map.count + CHUNK - 1) / CHUNK;
    // Each chunk writes to its own part of a buffer of maximum size, which is then compacted. Unused
    // pages of the buffer are never allocated.
    static thread_local Buffer<Splat> loose;
    static thread_local Buffer<Slope> loose_slopes;
    const bool spheres = out.shape == Shape::SPHERE;
    loose.resize((size_t)map.count);
    loose_slopes.resize(spheres ? 0 : (size_t)map.count);
    Slope* const slopes = loose_slopes.data();
    std::vector<int64_t> first((size_t)chunks + 1, 0);
    Splat* const splats = loose.data();
#pragma omp parallel
    {
        auto scratch = std::make_unique<ChunkScratch>();
#pragma omp for schedule(dynamic, 4)
        for (int64_t c = 0; c < chunks; ++c) {
            const int64_t begin = c * CHUNK;
            const int count = (int)std::min<int64_t>(CHUNK, map.count - begin);
            first[(size_t)c + 1] = spheres ? project_chunk(map, out, begin, count, *scratch, splats + begin)
                                           : project_ellipsoids(map, out, begin, count, splats + begin, slopes + begin);
        }
    }
    for (int64_t c = 0; c < chunks; ++c) first[(size_t)c + 1] += first[(size_t)c];
    out.splats.resize((size_t)first[(size_t)chunks]);
    out.slopes.resize(spheres ? 0 : (size_t)first[(size_t)chunks]);
#pragma omp parallel for schedule(static)
    for (int64_t c = 0; c < chunks; ++c) {
        std::copy_n(splats + c * CHUNK, first[(size_t)c + 1] - first[(size_t)c],
                    out.splats.data() + first[(size_t)c]);
        if (spheres) continue;
        std::copy_n(slopes + c * CHUNK, first[(size_t)c + 1] - first[(size_t)c],
                    out.slopes.data() + first[(size_t)c]);
    }
}

}  // namespace semsplat
