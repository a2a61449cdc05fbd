// What a depth image measured about points: surfaces, and space in front of them.
#pragma once

#include <cstdint>

#include "common/camera.hpp"

namespace semsplat {

// A depth image at a pose.
//   T_camera_points: [3, 4]
//   empty: [H, W] depth (m) up to which space is empty
//   min_depth: nearer points are ignored
struct DepthView {
    Pinhole camera;
    float T_camera_points[12];
    const float* empty;
    float min_depth;
};

// depth: [H, W] m, 0 where missing; confidence: [H, W] in [0, 1].
// Points within max(margin, margin_fraction * depth) of the depth lie on the surface.
struct MeasuredDepth {
    const float *depth, *confidence;
    float margin, margin_fraction;
};

// Sums [count] over views: confidences of those that measured through a point, the number of those that
// measured a surface there, and the smallest depth in any of them.
struct EvidenceSums {
    float *through, *support, *nearest;
};

// Adds what a view measured about points [count, 3]. With `weighted`, its confidence is multiplied by its
// reliability: the squared share of points on the surface among those that it measured.
void add_evidence(const float* points, int64_t count, const DepthView& view, const MeasuredDepth& measured,
                  bool weighted, const EvidenceSums& sums);

// Marks the points in space that a view measured as empty: 1, otherwise 0.
void mark_empty(const float* points, int64_t count, const DepthView& view, uint8_t* marks);

}  // namespace semsplat
