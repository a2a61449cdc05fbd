// Surface depth and intensity of a rendered view.
//
// images: [5 + S, H, W] of a rendering. centres: [3, H, W], the centres of its Gaussians in the map,
// composited like the colours.
#pragma once

#include <cmath>

#include "common/camera.hpp"
#include "common/constants.hpp"

namespace semsplat {

// Whether neighbours a and b of a pixel with depth z lie on its surface: their depths are close, or all
// three lie on one plane. Inverse depth is linear in the image of a plane, however steep it is.
inline bool same_surface(float a, float z, float b) {
    return std::fabs(b - a) <= MAX_DEPTH_STEP * z || std::fabs(z / a + z / b - 2.0f) <= 0.5f * MAX_DEPTH_STEP;
}

// Depth (m) where each pixel's ray meets the surface, 0 where the silhouette is below the minimum.
void surface_depth(const Pinhole& camera, const double* T_camera_map, const float* images, const float* centres,
                   float min_silhouette, float* depth);
// Luma as composited, 0 where the silhouette is below the minimum.
void intensity_of(const Pinhole& camera, const float* images, float min_silhouette, float* intensity);
// The same, moved to the projections of the mean centres, where the colours belong.
void centred_intensity(const Pinhole& camera, const double* T_camera_map, const float* images, const float* centres,
                       float min_silhouette, float* intensity);
// An observed image [3, H, W] sampled at those projections.
void texture_at_centres(const Pinhole& camera, const double* T_camera_map, const float* images,
                        const float* centres, float min_silhouette, const float* rgb, float* out);

}  // namespace semsplat
