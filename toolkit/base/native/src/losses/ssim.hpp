// Structural similarity and its derivative.
#pragma once

namespace semsplat {

// Mean SSIM (11x11 Gaussian window, sigma 1.5, zero padding) of planar images [C, H, W]. If
// `gradient` is not null, d(weight * sum over pixels of SSIM)/dx is added to it.
double ssim(const float* x, const float* y, int channels, int height, int width, float weight, float* gradient);

}  // namespace semsplat
