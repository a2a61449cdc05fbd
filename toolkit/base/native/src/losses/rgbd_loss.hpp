// Colour, depth and silhouette losses of mapping and their derivatives.
#pragma once

#include <cstdint>

namespace semsplat {

struct RgbdLoss {
    float colour, depth, silhouette;     // weights of the three terms
    float structure;                     // fraction of SSIM in the colour term
    float colour_scale, depth_scale;     // the loss is quadratic for smaller errors, linear for larger
    float min_silhouette;                // minimum silhouette of pixels in the depth term
};

// Value of the loss and its derivative with respect to the rendered images, summed over pixels.
//   images, gradient: [5 + S, H, W]; the gradient's first five channels are written.
//   rgb: [3, H, W]; depth: [H, W] m, 0 where missing; surface: [H, W] m, see surface_depth. Its
//   difference from the mean depth is held constant.
double rgbd_loss(const float* images, const float* rgb, const float* depth, const float* surface, int height,
                 int width, const RgbdLoss& loss, float* gradient);

}  // namespace semsplat
