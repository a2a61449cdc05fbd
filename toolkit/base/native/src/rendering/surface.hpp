// Surface depth and intensity of a rendered view.
//
// images: [5 + S, H, W] rendered images. centres: [3, H, W] centres of the Gaussians in the map frame,
// composited like the colours.
#pragma once

#include <cmath>

#include "common/camera.hpp"
#include "common/constants.hpp"

namespace semsplat {

// Whether neighbours a and b of a pixel with depth z are on its surface: their depths are close, or all
// three are on one plane. The inverse depth of a plane is linear in image coordinates.
inline bool same_surface(float a, float z, float b) {
    // Without a branch, so that loops over pixels are vectorised.
    const float step = std::fabs(b - a), bend = std::fabs(z / a + z / b - 2.0f);
    return (step <= MAX_DEPTH_STEP * z) | (bend <= 0.5f * MAX_DEPTH_STEP);
}

// Depth (m) of the intersection of each pixel's ray with the surface, 0 where the silhouette is below
// the minimum.
void surface_depth(const Pinhole& camera, const double* T_camera_map, const float* images, const float* centres,
                   float min_silhouette, float* depth);
// Composited luma, 0 where the silhouette is below the minimum.
void intensity_of(const Pinhole& camera, const float* images, float min_silhouette, float* intensity);
// Composited luma, resampled at the projections of the mean centres.
void centred_intensity(const Pinhole& camera, const double* T_camera_map, const float* images, const float* centres,
                       float min_silhouette, float* intensity);
// An observed image [3, H, W], sampled at the projections of the mean centres.
void texture_at_centres(const Pinhole& camera, const double* T_camera_map, const float* images,
                        const float* centres, float min_silhouette, const float* rgb, float* out);

}  // namespace semsplat
