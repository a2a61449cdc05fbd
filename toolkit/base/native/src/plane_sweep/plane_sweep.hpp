// Dense depth of an image from other images at known poses.
#pragma once

#include <array>
#include <vector>

#include "common/camera.hpp"

namespace semsplat {

struct SweepSource {
    const float* intensity;                     // [H, W] in [0, 1]
    std::array<double, 12> T_source_reference;  // [3, 4]
};

// The plane d of a pixel has the inverse depth first + d * step.
struct Sweep {
    Pinhole camera;          // of all images
    const float* intensity;  // [H, W] of the reference image
    std::vector<SweepSource> sources;
    int planes;
    const float* first;                 // [H, W] inverse depth of the first plane
    double step;                        // > 0
    double step_penalty, jump_penalty;  // of semi-global matching, for costs in [0, 1]
};

// Results [H, W]; the arrays belong to the caller.
struct SweepResult {
    float* plane;        // position between the first and the last plane; -1 if no source sees the pixel
    float* correlation;  // of the best plane, in [0, 1]
    float* margin;       // cost of the best other plane minus that of the best one, in [0, 1]
};

void sweep(const Sweep& sweep, const SweepResult& result);

}  // namespace semsplat
