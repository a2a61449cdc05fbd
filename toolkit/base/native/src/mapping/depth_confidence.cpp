#include "mapping/depth_confidence.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace semsplat {
namespace {

// The border is mirrored without repeating the outermost pixel, as by OpenCV's default.
int mirrored(int i, int size) {
    if (size == 1) return 0;
    return i < 0 ? -i : (i < size ? i : 2 * size - 2 - i);
}

// Sets the values beside a row of `width` values.
void mirror_ends(float* row, int width) {
    row[-1] = row[mirrored(-1, width)];
    row[width] = row[mirrored(width, width)];
}

// Means over 3x3 pixels of the inverse of a depth image.
void smooth_inverse(const float* depth, int width, int height, float* smooth) {
#pragma omp parallel
    {
        std::vector<float> buffer(width + 2);
        float* sums = buffer.data() + 1;
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) {
            const float* above = depth + (size_t)mirrored(y - 1, height) * width;
            const float* own = depth + (size_t)y * width;
            const float* below = depth + (size_t)mirrored(y + 1, height) * width;
#pragma omp simd
            for (int x = 0; x < width; ++x) {
                const float a = above[x] > 0 ? 1 / above[x] : 0, b = own[x] > 0 ? 1 / own[x] : 0;
                const float c = below[x] > 0 ? 1 / below[x] : 0;
                sums[x] = a + b + c;
            }
            mirror_ends(sums, width);
            float* out = smooth + (size_t)y * width;
#pragma omp simd
            for (int x = 0; x < width; ++x) out[x] = (sums[x - 1] + sums[x] + sums[x + 1]) * (1 / 9.0f);
        }
    }
}

}  // namespace

void depth_confidence(const float* depth, int width, int height, const ConfidenceLimits& limits,
                      float* confidence) {
    std::vector<float> smooth((size_t)width * height);
    smooth_inverse(depth, width, height, smooth.data());
#pragma omp parallel
    {
        std::vector<float> buffers(2 * (size_t)(width + 2));
        float *sums = buffers.data() + 1, *differences = sums + width + 2;
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) {
            const float* above = smooth.data() + (size_t)mirrored(y - 1, height) * width;
            const float* own = smooth.data() + (size_t)y * width;
            const float* below = smooth.data() + (size_t)mirrored(y + 1, height) * width;
#pragma omp simd
            for (int x = 0; x < width; ++x) {
                sums[x] = above[x] + 2 * own[x] + below[x];
                differences[x] = below[x] - above[x];
            }
            mirror_ends(sums, width);
            mirror_ends(differences, width);
            const float* z = depth + (size_t)y * width;
            float* out = confidence + (size_t)y * width;
#pragma omp simd
            for (int x = 0; x < width; ++x) {
                // Inverse depth is linear on a plane; its slope per unit of the ray is the plane's tilt.
                const float u = (sums[x + 1] - sums[x - 1]) * (limits.fx / 8) * z[x];
                const float v = (differences[x - 1] + 2 * differences[x] + differences[x + 1]) * (limits.fy / 8) * z[x];
                const float facing = std::max(1 / std::sqrt(1 + u * u + v * v), limits.min_oblique);
                const float near = limits.full / std::max(z[x], limits.full);
                out[x] = z[x] > 0 ? facing * near * near : 0;
            }
        }
    }
}

}  // namespace semsplat
