#include "losses/rgbd_loss.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/constants.hpp"
#include "common/simd.hpp"
#include "losses/ssim.hpp"

namespace semsplat {
namespace {

// Pixels that are processed together; their values are added in single precision.
enum { CHUNK = 1024 };

// Charbonnier loss scale * (sqrt(1 + (e / scale)^2) - 1); returns its derivative with respect to e.
SEMSPLAT_INLINE Floats robust(Floats error, Floats scale, Floats* value) {
    const Floats q = error / scale, root = square_root(fma(q, q, all(1.0f)));
    *value = scale * (root - all(1.0f));
    return q / root;
}

// Images with one value per pixel and channel.
struct Images {
    const float *rendered[BASE_CHANNELS], *rgb[3], *depth, *surface;
    float* gradient[BASE_CHANNELS];
};

// Losses of one vector of pixels; writes their gradients.
SEMSPLAT_INLINE Floats pixel_losses(const Images& at, size_t i, const RgbdLoss& loss) {
    const Floats zero = all(0.0f), flat = all(loss.colour * (1 - loss.structure) / 3);
    Floats sum = zero, value;
    for (int c = 0; c < 3; ++c) {
        const Floats error = load(at.rendered[c] + i) - load(at.rgb[c] + i);
        store(at.gradient[c] + i, flat * robust(error, all(loss.colour_scale), &value));
        sum = fma(flat, value, sum);
    }
    const Floats silhouette = load(at.rendered[SILHOUETTE] + i), measured = load(at.depth + i);
    const Floats surface = load(at.surface + i);
    const Mask seen = lt(zero, measured);
    const Mask solid = both(both(seen, lt(zero, surface)), lt(all(loss.min_silhouette), silhouette));
    const Floats inverse = keep(solid, all(1.0f) / silhouette);
    const Floats mean = load(at.rendered[DEPTH_SUM] + i) * inverse;
    // The sensor's noise, and therefore the scale, grows with the square of the depth.
    const Floats least = all(MIN_NOISE_DEPTH_M * MIN_NOISE_DEPTH_M);
    const Floats scale = all(loss.depth_scale) * maximum(measured * measured, least);
    const Floats slope = keep(solid, all(loss.depth) * robust(surface - measured, scale, &value));
    const Floats open = keep(seen, all(loss.silhouette));
    store(at.gradient[DEPTH_SUM] + i, slope * inverse);
    store(at.gradient[SILHOUETTE] + i, fnma(slope * mean, inverse, zero - open));
    return fma(open, all(1.0f) - silhouette, fma(keep(solid, all(loss.depth)), keep(solid, value), sum));
}

// The same for fewer pixels than a vector has.
float last_losses(const Images& at, size_t i, int count, const RgbdLoss& loss) {
    float from[2 * BASE_CHANNELS][LANES] = {}, to[BASE_CHANNELS][LANES], values[LANES], total = 0;
    const Images parts = {{from[0], from[1], from[2], from[3], from[4]},
                          {from[5], from[6], from[7]}, from[8], from[9],
                          {to[0], to[1], to[2], to[3], to[4]}};
    for (int c = 0; c < BASE_CHANNELS; ++c) std::copy_n(at.rendered[c] + i, count, from[c]);
    for (int c = 0; c < 3; ++c) std::copy_n(at.rgb[c] + i, count, from[5 + c]);
    std::copy_n(at.depth + i, count, from[8]);
    std::copy_n(at.surface + i, count, from[9]);
    store(values, pixel_losses(parts, 0, loss));
    for (int c = 0; c < BASE_CHANNELS; ++c) std::copy_n(to[c], count, at.gradient[c] + i);
    for (int k = 0; k < count; ++k) total += values[k];
    return total;
}

}  // namespace

double rgbd_loss(const float* images, const float* rgb, const float* depth, const float* surface, int height,
                 int width, const RgbdLoss& loss, float* gradient) {
    const size_t n = (size_t)height * width;
    Images at = {{}, {rgb, rgb + n, rgb + 2 * n}, depth, surface, {}};
    for (int c = 0; c < BASE_CHANNELS; ++c) {
        at.rendered[c] = images + c * n;
        at.gradient[c] = gradient + c * n;
    }
    const int64_t chunks = (int64_t)(n + CHUNK - 1) / CHUNK;
    std::vector<double> sums((size_t)chunks);
#pragma omp parallel for schedule(static)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const size_t end = std::min(n, (size_t)(chunk + 1) * CHUNK);
        size_t i = (size_t)chunk * CHUNK;
        Floats sum = all(0.0f);
        for (; i + LANES <= end; i += LANES) sum = sum + pixel_losses(at, i, loss);
        float lanes[LANES], total = i < end ? last_losses(at, i, (int)(end - i), loss) : 0.0f;
        store(lanes, sum);
        for (const float lane : lanes) total += lane;
        sums[(size_t)chunk] = total;
    }
    double total = 0;
    for (double s : sums) total += s;
    if (loss.structure > 0 && loss.colour > 0) {
        const float structure_weight = loss.colour * loss.structure;
        total += structure_weight * n * (1 - ssim(images, rgb, 3, height, width, -structure_weight / 3, gradient));
    }
    return total / n;
}

}  // namespace semsplat
