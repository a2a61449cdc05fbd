// Confidence of measured depth, from obliqueness and distance; see depth_views.py.
#pragma once

namespace semsplat {

// fx, fy: focal lengths in pixels; full: depth (m) up to which a surface has full confidence;
// min_oblique: confidence of a surface at a grazing angle, relative to one that faces the camera.
struct ConfidenceLimits {
    float fx, fy, full, min_oblique;
};

// depth: [H, W] m, 0 where missing. confidence: [H, W] in [0, 1], 0 where the depth is missing.
void depth_confidence(const float* depth, int width, int height, const ConfidenceLimits& limits,
                      float* confidence);

}  // namespace semsplat
