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

// Sets the candidates of inverse [H, W] that no surface and no lines support to 0.
// candidates: [H, W], 1 or 0; out: [H, W], a copy of inverse on entry.
void remove_flying_pixels(const float* inverse, const uint8_t* candidates, int width, int height,
                          const FlyingPixels& limits, float* out);

}  // namespace semsplat
