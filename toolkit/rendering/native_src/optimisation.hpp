// Sparse Adam and the photometric loss of mapping, with their derivatives.
#pragma once

#include <cstdint>

namespace semsplat {

// Adam on the rows `ids` of a parameter [N, width] with compact gradients [V, width].
struct AdamGroup {
    float* parameter;
    float* first;            // running mean of gradients, [N, width]
    float* second;           // running mean of squares, [N, width]
    const float* gradient;   // [V, width]
    int width;
    float learning_rate;
};

void adam_step(const int64_t* ids, int64_t count, int32_t* steps, const AdamGroup* groups, int group_count,
               float beta1, float beta2, float epsilon);

// Mean SSIM (11x11 Gaussian window, sigma 1.5) of two planar images [C, H, W] and, where
// `gradient` is not null, d(weight * mean SSIM)/d(x) added to it.
double ssim(const float* x, const float* y, int channels, int height, int width, float weight, float* gradient);

}  // namespace semsplat
