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
    const int side = 2 * limits.radius + 1;
    const float enough = limits.min_support * (float)(side * side - 1);
    int alike = 0, measured = 0;
    // By rings: on most surfaces the nearest neighbours suffice.
    for (int ring = 1; ring <= limits.radius; ++ring) {
        for (int j = -ring; j <= ring; ++j) {
            const int columns = std::abs(j) == ring ? 1 : 2 * ring;
            for (int i = -ring; i <= ring; i += columns) {
                const float other = image.at(x + i, y + j);
                measured += other > 0;
                alike += other > 0 && std::abs(other - own) <= (float)ring * step;
            }
        }
        if ((float)alike >= enough) return true;
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

int64_t remove_flying_pixels(const InverseDepth& inverse, const FlyingPixels& limits, float* out) {
    const Image image{inverse.own, inverse.width, inverse.height};
    int64_t removed = 0;
#pragma omp parallel for schedule(dynamic, 8) reduction(+ : removed)
    for (int y = 0; y < inverse.height; ++y) {
        for (int x = 0; x < inverse.width; ++x) {
            const size_t i = (size_t)y * inverse.width + x;
            const float own = inverse.own[i], step = std::max(limits.noise, limits.max_slope * own);
            const bool between =
                own > 0 && inverse.nearest[i] - own > step && own - inverse.farthest[i] > step;
            const bool flies =
                between && !has_neighbours(image, x, y, limits) && !continues(image, x, y, limits);
            out[i] = flies ? 0.0f : own;
            removed += flies;
        }
    }
    return removed;
}

}  // namespace semsplat
