// The image losses of mapping with their derivatives.
#pragma once

#include <cstdint>

namespace semsplat {

struct RgbdLoss {
    float colour, depth, silhouette;     // weights of the three terms
    float structure;                     // share of SSIM in the colour term
    float colour_scale, depth_scale;     // errors well below are quadratic, above linear
    float least_silhouette;              // depth counts where the map is at least this opaque
};

// Value of the loss and its derivative by the rendered images, summed over pixels.
//   images, gradient: [5 + S, H, W]; the gradient's first five channels are written.
//   rgb: [3, H, W]; depth: [H, W] m, 0 where missing; surface: [H, W] m, see surface_depth. Its
//   difference from the mean depth is held constant.
double rgbd_loss(const float* images, const float* rgb, const float* depth, const float* surface, int height,
                 int width, const RgbdLoss& loss, float* gradient);

}  // namespace semsplat
