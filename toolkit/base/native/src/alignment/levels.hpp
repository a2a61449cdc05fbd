// Pyramid levels of frames and of the model views that frames are aligned to.
#pragma once

#include "common/camera.hpp"

namespace semsplat {

// One pyramid level of the model view.
//   texture: [H, W, 4] intensity, its x and y derivatives, depth (m); 0 where invalid
//   surface: [H, W, 4] unit normal (camera frame) and plane offset n . vertex; 0 where invalid
struct ModelLevel {
    Pinhole camera;
    const float* texture;
    const float* surface;
};

// One pyramid level of the frame. intensity: [H, W] in [0, 1]; depth: [H, W] m, 0 where missing.
struct FrameLevel {
    Pinhole camera;
    const float* intensity;
    const float* depth;
};

void build_model_level(const Pinhole& camera, const float* intensity, const float* depth, float* texture,
                       float* surface);
// Depth differences beyond max_difference, as a fraction of the depth, belong to another surface.
void halve(int width, int height, const float* intensity, const float* depth, float max_difference,
           float* half_intensity, float* half_depth);

}  // namespace semsplat
