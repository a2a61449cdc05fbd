// The pixels around a pixel show how often its intensity occurs on the near surface, away from its border,
// and on the far one. The pixel belongs to the surface on which it is more frequent.

#include "plane_sweep/fattening.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "common/simd.hpp"

namespace semsplat {
namespace {

enum { RADIUS = 11 };
// Least ratio of the inverse depths of a near surface and of the one behind it.
constexpr float EDGE = 1.05f;
// Intensities that differ by this do not count as equal.
constexpr float CONTRAST = 0.1f;
// The far surface must explain the pixel better by this factor, and show at least so many pixels.
constexpr float PREFERENCE = 1.5f, MIN_FAR = 3.0f;

// An image with a margin that windows of the last LANES columns may read.
struct Padded {
    const int width;
    std::vector<float> values;

    Padded(const MatchedDepth& d, float outside)
        : width(d.width + 2 * RADIUS + LANES), values((size_t)width * (d.height + 2 * RADIUS), outside) {}

    float* at(int x, int y) { return &values[(size_t)(y + RADIUS) * width + (x + RADIUS)]; }
    const float* at(int x, int y) const { return &values[(size_t)(y + RADIUS) * width + (x + RADIUS)]; }
};

struct Images {
    Padded intensity, any, inner;  // inverse depth of all pixels, infinite if unknown; of those away from borders
    Padded border, middle;         // of pixels on the near side of a depth edge, else 0; between it and the far side

    Images(const MatchedDepth& d) : intensity(d, 0.0f), any(d, HUGE_VALF), inner(d, 0.0f), border(d, 0.0f), middle(d, 0.0f) {
        for (int y = 0; y < d.height; ++y) {
            for (int x = 0; x < d.width; ++x) {
                const size_t pixel = (size_t)y * d.width + x;
                const float q = d.inverse_depth[pixel], behind = d.behind[pixel];
                *intensity.at(x, y) = d.intensity[pixel];
                if (!(q > 0)) continue;
                *any.at(x, y) = q;
                *(q > EDGE * behind ? border : inner).at(x, y) = q;
                *middle.at(x, y) = 0.5f * (q + behind);
            }
        }
    }
};

// Mask of the pixels (x, y), (x + 1, y) ... that look like the surface behind them.
Mask look_like_background(const Images& images, int x, int y, Floats own) {
    const Floats intensity = load(images.intensity.at(x, y)), one = all(1.0f);
    const Floats middle = load(images.middle.at(x, y)), nearest = own + (own - middle);
    Floats far = all(0.0f), near = far, like_far = far, like_near = far;
    for (int dy = -RADIUS; dy <= RADIUS; ++dy) {
        // Every second pixel of a disc, as on a chessboard.
        const int half = (int)std::sqrt((float)(RADIUS * RADIUS - dy * dy));
        for (int dx = -half + ((half + dy) & 1); dx <= half; dx += 2) {
            const Floats q = load(images.any.at(x + dx, y + dy)), r = load(images.inner.at(x + dx, y + dy));
            const Mask is_far = lt(q, middle), is_near = both(ge(r, middle), lt(r, nearest));
            const Floats difference = (load(images.intensity.at(x + dx, y + dy)) - intensity) * all(1 / CONTRAST);
            const Floats share = maximum(fnma(difference, difference, one), all(0.0f)), similarity = share * share;
            far = far + keep(is_far, one);
            near = near + keep(is_near, one);
            like_far = like_far + keep(is_far, similarity);
            like_near = like_near + keep(is_near, similarity);
        }
    }
    // Frequencies like_far / far and like_near / near. Without pixels of the near surface, it explains nothing.
    const Floats explained = all(PREFERENCE) * like_near * far;
    return both(ge(far, all(MIN_FAR)), ge(like_far * near + keep(lt(near, one), one), explained));
}

}  // namespace

void remove_fattening(const MatchedDepth& d, float* inverse_depth) {
    const Images images(d);
    std::copy(d.inverse_depth, d.inverse_depth + (size_t)d.width * d.height, inverse_depth);
#pragma omp parallel for schedule(dynamic, 4)
    for (int y = 0; y < d.height; ++y) {
        for (int x = 0; x < d.width; x += LANES) {
            const Floats own = load(images.border.at(x, y));
            const uint32_t beside_edge = bits(lt(all(0.0f), own));
            if (!beside_edge) continue;
            const uint32_t removed = beside_edge & bits(look_like_background(images, x, y, own));
            for (int i = 0; i < std::min<int>(LANES, d.width - x); ++i) {
                if (removed >> i & 1) inverse_depth[(size_t)y * d.width + (x + i)] = 0.0f;
            }
        }
    }
}

}  // namespace semsplat
