// Bundle adjustment of keyframe poses and inverse depths.
#pragma once

#include <cstdint>

namespace semsplat {

// A landmark is a pixel of its anchor, a pose, with an inverse depth. The arrays belong to the caller.
struct Bundle {
    int poses, landmarks;
    int64_t observations;
    double* T_camera_world;       // [poses, 3, 4], changed
    const uint8_t* fixed;         // [poses], whether a pose is held
    const int32_t* anchor;        // [landmarks]
    const double* anchor_pixel;   // [landmarks, 2]
    double* inverse_depth;        // [landmarks], changed
    const double* prior;          // [landmarks, 2], expected inverse depth and its information
    const int32_t* landmark;      // [observations], in ascending order
    const int32_t* pose;          // [observations], not the landmark's anchor
    const double* pixel;          // [observations, 2]
    double* distance;             // [observations], result: reprojection errors in pixels
};

struct BundleSettings {
    double fx, fy, cx, cy;
    int iterations;
    double huber;              // reprojection errors above it have linear cost (pixels)
    double min_inverse_depth;  // lower bound of the inverse depths
    double min_decrease;       // a smaller relative decrease of the cost ends the iterations
    bool focal;                // estimate a common factor of fx and fy, too
};

struct BundleResult {
    double cost_before, cost;
    double focal_factor;
    double focal_information;  // of the factor's logarithm, with all other parameters eliminated
    int iterations;
    bool converged;
};

// Levenberg-Marquardt on Huber's cost. Landmarks are eliminated (Schur complement).
BundleResult adjust(const Bundle& bundle, const BundleSettings& settings);

}  // namespace semsplat
