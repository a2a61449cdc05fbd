// Depth of an image on which the depths of other images agree.
#pragma once

#include <array>
#include <vector>

#include "common/camera.hpp"

namespace semsplat {

struct DepthImage {
    const float* inverse_depth;                // [H, W], 0 where unknown
    std::array<double, 12> T_other_reference;  // [3, 4]
};

struct ConsensusInput {
    Pinhole camera;              // of all images
    const float* inverse_depth;  // [H, W] of the reference image, 0 where unknown
    std::vector<DepthImage> others;
    float tolerance;  // maximum relative difference of depths that agree
    float in_front;   // relative difference from which another image sees through the point
};

// Results [H, W], 0 where the depth is unknown; the arrays belong to the caller.
struct Consensus {
    float* inverse_depth;  // mean of the reference image and of those that agree
    float* spread;         // their relative standard deviation
    float* parallax;       // largest motion in another image (pixels) if the depth changes by its own amount
    float* agreeing;       // number of other images that agree
    float* conflicting;    // number of those that see a surface behind the point
};

void compare_depths(const ConsensusInput& input, const Consensus& result);

}  // namespace semsplat
