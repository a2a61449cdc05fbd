#include "losses/rgbd_loss.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/constants.hpp"
#include "losses/ssim.hpp"

namespace semsplat {
namespace {

// Charbonnier loss scale * (sqrt(1 + (e / scale)^2) - 1); returns its derivative with respect to e.
inline float robust(float error, float scale, float* value) {
    const float q = error / scale, root = std::sqrt(1.0f + q * q);
    *value = scale * (root - 1.0f);
    return q / root;
}

}  // namespace

double rgbd_loss(const float* images, const float* rgb, const float* depth, const float* surface, int height,
                 int width, const RgbdLoss& loss, float* gradient) {
    const size_t n = (size_t)height * width;
    const float flat = loss.colour * (1 - loss.structure) / 3;
    std::vector<double> sums((size_t)height);
#pragma omp parallel for schedule(static)
    for (int row = 0; row < height; ++row) {
        float sum = 0;
        for (size_t i = (size_t)row * width; i < (size_t)(row + 1) * width; ++i) {
            float value;
            for (int c = 0; c < 3; ++c) {
                gradient[c * n + i] = flat * robust(images[c * n + i] - rgb[c * n + i], loss.colour_scale, &value);
                sum += flat * value;
            }
            const float silhouette = images[SILHOUETTE * n + i], measured = depth[i];
            const bool seen = measured > 0, solid = seen && surface[i] > 0 && silhouette > loss.min_silhouette;
            const float inverse = solid ? 1.0f / silhouette : 0.0f;
            const float mean = images[DEPTH_SUM * n + i] * inverse;
            // The sensor's noise, and therefore the scale, grows with the square of the depth.
            const float scale = loss.depth_scale * std::max(measured * measured, MIN_NOISE_DEPTH_M * MIN_NOISE_DEPTH_M);
            const float slope = solid ? loss.depth * robust(surface[i] - measured, scale, &value) : 0.0f;
            if (solid) sum += loss.depth * value;
            gradient[DEPTH_SUM * n + i] = slope * inverse;
            gradient[SILHOUETTE * n + i] = -slope * mean * inverse - (seen ? loss.silhouette : 0.0f);
            if (seen) sum += loss.silhouette * (1 - silhouette);
        }
        sums[(size_t)row] = sum;
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
