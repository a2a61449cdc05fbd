// Removal of depth between the surfaces at a depth edge.
#pragma once

#include <cstdint>

namespace semsplat {

// Inverse depth in 1 / m. Changes are per pixel; slopes are changes as a fraction of the inverse depth.
struct FlyingPixels {
    int radius;          // half-size of the window around a pixel
    float noise;         // smallest change that counts
    float max_slope;     // maximum change between neighbours of one surface
    float min_support;   // minimum fraction of neighbours on the surface of a pixel
    float linear;        // maximum deviation from a line, as a fraction
    float max_line_slope;
    int min_directions;  // minimum number of lines that continue in a pixel
};

// Inverse depth [H, W] in 1 / m, 0 where missing, and its largest and smallest values in the window around
// each pixel; smallest leaves out missing pixels.
struct InverseDepth {
    const float *own, *nearest, *farthest;
    int width, height;
};

// Copies the inverse depth without the pixels between nearer and farther ones that no surface and no lines
// support, which are set to 0. Returns their number.
int64_t remove_flying_pixels(const InverseDepth& inverse, const FlyingPixels& limits, float* out);

}  // namespace semsplat
