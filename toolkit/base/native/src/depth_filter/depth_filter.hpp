// Denoising of depth images.
#pragma once

namespace semsplat {

struct DepthFilter {
    const int* radii;      // half-sizes of windows, large to small
    int count;             // number of radii
    double noise;          // standard deviation of inverse depth (1 / m)
    double slack;          // tolerance of a window's variance above that of the noise, in standard deviations
    double min_fraction;   // minimum fraction of pixels with depth in a window
    int radius;            // half-size of the averaging window for pixels without a plane
    double edge;           // maximum difference (1 / m) of neighbours in the averaging window
};

// Filters inverse depth [H, W] (1 / m, 0 where missing). Each pixel takes the value of a plane fitted to the
// largest window around it that is planar within the noise. If there is none, it takes the mean of the
// neighbours that differ by less than `edge`, weighted by distance and similarity.
void smooth_inverse_depth(const float* inverse, int width, int height, const DepthFilter& filter, float* out);

}  // namespace semsplat
