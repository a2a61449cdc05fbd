// Depth of surfaces that reaches beyond their borders in the image.
#pragma once

namespace semsplat {

struct MatchedDepth {
    int width, height;
    const float* intensity;      // [H, W] in [0, 1]
    const float* inverse_depth;  // [H, W], 0 where unknown
    const float* behind;         // [H, W], behind the depth edges near each pixel, infinite where there is none
};

// Inverse depth [H, W] without that of pixels beside a depth edge that look like the surface behind it.
void remove_fattening(const MatchedDepth& image, float* inverse_depth);

}  // namespace semsplat
