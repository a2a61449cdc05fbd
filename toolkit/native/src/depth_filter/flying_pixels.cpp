#include "depth_filter/flying_pixels.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace semsplat {
namespace {

struct Image {
    const float* inverse;
    int width, height;
    float at(int x, int y) const {
        return x >= 0 && y >= 0 && x < width && y < height ? inverse[(size_t)y * width + x] : 0.0f;
    }
};

bool has_neighbours(const Image& image, int x, int y, const FlyingPixels& limits) {
    const float own = image.at(x, y), step = std::max(limits.noise, limits.max_slope * own);
    int alike = 0, measured = 0;
    for (int j = -limits.radius; j <= limits.radius; ++j) {
        for (int i = -limits.radius; i <= limits.radius; ++i) {
            const float other = image.at(x + i, y + j);
            if ((!i && !j) || !(other > 0)) continue;
            ++measured;
            alike += std::abs(other - own) <= (float)std::max(std::abs(i), std::abs(j)) * step;
        }
    }
    return (float)alike >= limits.min_support * (float)measured;
}

bool continues(const Image& image, int x, int y, const FlyingPixels& limits) {
    const float own = image.at(x, y);
    const float tolerance = std::max(limits.noise, limits.linear * own), steepest = limits.max_line_slope * own;
    int directions = 0;
    for (int j = -1; j <= 1; ++j) {
        for (int i = -1; i <= 1; ++i) {
            if (!i && !j) continue;
            const float near = image.at(x + i, y + j), far = image.at(x + 2 * i, y + 2 * j);
            if (!(near > 0) || !(far > 0)) continue;
            const bool line = std::abs(2 * near - far - own) <= tolerance;
            directions += line && std::abs(near - own) <= steepest;
        }
    }
    return directions >= limits.min_directions;
}

}  // namespace

void remove_flying_pixels(const float* inverse, const uint8_t* candidates, int width, int height,
                          const FlyingPixels& limits, float* out) {
    const Image image{inverse, width, height};
#pragma omp parallel for schedule(static)
    for (int y = 0; y < height; ++y) {
        for (int x = 0; x < width; ++x) {
            const size_t i = (size_t)y * width + x;
            if (candidates[i] && !has_neighbours(image, x, y, limits) && !continues(image, x, y, limits)) out[i] = 0;
        }
    }
}

}  // namespace semsplat
