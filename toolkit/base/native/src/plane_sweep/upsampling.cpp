#include "plane_sweep/upsampling.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace semsplat {
namespace {

// Difference in intensity that counts like the distance of one pixel.
constexpr float PIXEL_CONTRAST = 0.02f;

// A pixel of the full image between two of the half image.
struct Between {
    int first;
    float share;  // of the second

    Between(int pixel, int count) {
        const float place = 0.5f * (float)pixel - 0.25f;
        first = std::min(std::max((int)std::floor(place), 0), std::max(count - 2, 0));
        share = std::min(std::max(place - (float)first, 0.0f), 1.0f);
    }
};

float doubled(const HalfDepth& half, const Between& x, const Between& y, float intensity, float max_step) {
    float least = 0, most = 0, sum = 0, similar = 0, best = 0;
    bool any = false, all = true;
    for (int k = 0; k < 4; ++k) {
        const int column = std::min(x.first + k % 2, half.width - 1), row = std::min(y.first + k / 2, half.height - 1);
        const size_t i = (size_t)row * half.width + column;
        const float q = half.inverse_depth[i];
        if (!(q > 0)) {
            all = false;
            continue;
        }
        const float weight = (k % 2 ? x.share : 1 - x.share) * (k / 2 ? y.share : 1 - y.share);
        const float difference = std::fabs(half.intensity[i] - intensity) + PIXEL_CONTRAST * (1 - weight);
        least = any ? std::min(least, q) : q;
        most = any ? std::max(most, q) : q;
        sum += weight * q;
        if (!any || difference < best) {
            best = difference;
            similar = q;
        }
        any = true;
    }
    return all && most - least < max_step ? sum : similar;
}

}  // namespace

void upsample_depth(const HalfDepth& half, int width, int height, const float* intensity, float max_step,
                  float* inverse_depth) {
#pragma omp parallel for schedule(static)
    for (int row = 0; row < height; ++row) {
        const Between y(row, half.height);
        for (int column = 0; column < width; ++column) {
            const size_t i = (size_t)row * width + column;
            inverse_depth[i] = doubled(half, Between(column, half.width), y, intensity[i], max_step);
        }
    }
}

}  // namespace semsplat
