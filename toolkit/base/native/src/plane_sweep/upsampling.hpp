// Depth of an image from that of the image of half the size.
#pragma once

namespace semsplat {

struct HalfDepth {
    int width, height;           // of the half image
    const float* intensity;      // [h, w]
    const float* inverse_depth;  // [h, w], 0 where unknown
};

// Inverse depth [H, W] of the image of twice the size, 0 where unknown: interpolated where the four pixels
// around differ by at most max_step, else that of the one with the most similar intensity.
void upsample_depth(const HalfDepth& half, int width, int height, const float* intensity, float max_step,
                  float* inverse_depth);

}  // namespace semsplat
