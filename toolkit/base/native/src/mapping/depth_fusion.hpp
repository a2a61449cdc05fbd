// Moves the centres of Gaussians to the depth that a keyframe measured; see depth_fusion.py.
#pragma once

#include <cstdint>

#include "common/camera.hpp"

namespace semsplat {

// The depth image of the newest keyframe.
//   depth: [H, W] m, 0 where missing
//   T_camera_map: [3, 4]
//   position: [3] of the camera in the map
struct MeasuringView {
    Pinhole camera;
    const float* depth;
    float T_camera_map[12], position[3];
};

// The keyframes of the map: indices [count] in order, camera positions [count, 3].
struct SeedingKeyframes {
    const int32_t* indices;
    const float* positions;
    int64_t count;
};

// As the constants of depth_fusion.py.
struct FusionLimits {
    float weight, min_weight, max_inverse_distance, max_distance, edge, min_depth;
};

// Moves centres [count, 3] in place, and sets seeded_by [count] to the newest keyframe where its measurement
// alone determines the centre.
void fuse_depth(float* centres, int32_t* seeded_by, int64_t count, const MeasuringView& view,
                const SeedingKeyframes& keyframes, const FusionLimits& limits);

}  // namespace semsplat
