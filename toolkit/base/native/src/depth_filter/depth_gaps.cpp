#include "depth_filter/depth_gaps.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace semsplat {

void fill_depth_gaps(const float* inverse, int width, int height, float max_difference, float* out) {
    const auto at = [=](int x, int y) {
        return x >= 0 && y >= 0 && x < width && y < height ? inverse[(size_t)y * width + x] : 0.0f;
    };
    constexpr int STEPS[4][2] = {{1, 0}, {-1, 1}, {0, 1}, {1, 1}};
    std::copy_n(inverse, (size_t)width * height, out);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < height; ++y) {
        for (int x = 0; x < width; ++x) {
            const size_t pixel = (size_t)y * width + x;
            if (inverse[pixel] != 0.0f) continue;
            float total = 0, count = 0;
            for (const auto& [i, j] : STEPS) {
                const float one = at(x - i, y - j), other = at(x + i, y + j), mean = 0.5f * (one + other);
                if (one > 0 && other > 0 && std::abs(one - other) < max_difference * mean) {
                    total += mean;
                    ++count;
                }
            }
            if (count > 0) out[pixel] = total / count;
        }
    }
}

}  // namespace semsplat
