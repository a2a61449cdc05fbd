// Noise taken out of depth.
#pragma once

namespace semsplat {

struct DepthFilter {
    const int* radii;      // half-sizes of windows, large to small
    int count;             // of them
    double noise;          // standard deviation of inverse depth (1 / m)
    double slack;          // by how many standard deviations a window's variance may exceed the noise's
    double least_share;    // of a window's pixels, measured
    int reach;             // half-size of the window where none is a plane
    double edge;           // difference (1 / m) from which neighbours there do not count
};

// Of each pixel, inverse depth [H, W] (1 / m, 0 where missing) on the plane through the largest window about it
// that is one to within the noise; where none is, the mean of the neighbours that differ by less than `edge`,
// near and alike ones counting more.
void smooth_inverse_depth(const float* inverse, int width, int height, const DepthFilter& filter, float* out);

}  // namespace semsplat
