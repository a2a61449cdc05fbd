// Dense alignment of a frame to a rendered model: image pyramids and normal equations.
#pragma once

#include <cstdint>

#include "common/camera.hpp"

namespace semsplat {

// One pyramid level of the rendered model, ready to be looked up.
//   texture: [H, W, 4] intensity, its x and y derivative, depth (m), 0 where unusable
//   surface: [H, W, 4] unit normal (camera frame) and plane offset n . vertex, 0 where unusable
struct ModelLevel {
    Pinhole camera;
    const float* texture;
    const float* surface;
};

// The same level of the frame. intensity: [H, W] in [0, 1]; depth: [H, W] m, 0 where missing.
struct FrameLevel {
    Pinhole camera;
    const float* intensity;
    const float* depth;
};

struct AlignmentSettings {
    double T_model_frame[12];
    double gain, bias;               // frame intensity -> model intensity
    double sigma_intensity;          // scale of the photometric residual
    double sigma_depth;              // scale of the point-to-plane residual at 1 m, in m
    double max_distance;             // gate on model depth differences, as a share of depth
    double photometric_weight;       // of the photometric term against the geometric one
};

enum { PARAMETERS = 8, NORMAL_SIZE = 36 };  // translation, rotation, gain, bias

struct NormalEquations {
    double H[NORMAL_SIZE];  // upper triangle, row by row
    double g[PARAMETERS];
    double intensity_pixels, depth_pixels;  // residuals that took part
    double intensity_squares, depth_squares;  // sums of weight * squared residual
    double frame_pixels;                    // frame pixels with depth that fall into the model's image
};

// Depth (m) at which each pixel's ray meets the drawn surface, 0 where thinner than asked.
// images: [5, H, W] of a rendering; centres: [3, H, W], its Gaussians' centres in the map.
void surface_depth(const Pinhole& camera, const double* T_camera_map, const float* images, const float* centres,
                   float least_silhouette, float* depth);
void intensity_of(const Pinhole& camera, const float* images, float least_silhouette, float* intensity);
// The same moved to where the colours belong: the projections of the mean centres.
void centred_intensity(const Pinhole& camera, const double* T_camera_map, const float* images, const float* centres,
                       float least_silhouette, float* intensity);
// An observed image [3, H, W] sampled at those projections.
void texture_at_centres(const Pinhole& camera, const double* T_camera_map, const float* images,
                        const float* centres, float least_silhouette, const float* rgb, float* out);
void build_model_level(const Pinhole& camera, const float* intensity, const float* depth, float* texture,
                       float* surface);
// edge: depth differences beyond this share of the depth are another surface.
void halve(int width, int height, const float* intensity, const float* depth, float edge, float* half_intensity,
           float* half_depth);
void accumulate(const ModelLevel& model, const FrameLevel& frame, const AlignmentSettings& settings,
                NormalEquations& out);

}  // namespace semsplat
