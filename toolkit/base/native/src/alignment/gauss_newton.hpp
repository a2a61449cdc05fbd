// Pose and exposure of a frame against a view of the map, from coarse to fine.
#pragma once

#include "alignment/levels.hpp"
#include "alignment/normal_equations.hpp"

namespace semsplat {

struct GaussNewtonSettings {
    int iterations;               // at most, per level
    int min_pixels;               // fewer residuals end the alignment
    double max_distance;          // at the finest level; doubled at each coarser level
    double photometric_weight;
    double min_translation;       // m; smaller steps end the finest level, four times as large ones
    double min_rotation;          // rad;                                  each coarser level
    bool adjust_exposure;         // at the finest level
    double prior_gain, prior_bias;
};

struct PoseEstimate {
    double T_model_frame[12];
    double gain, bias;
    double sigma_intensity, sigma_depth;
    int iterations;
    bool converged;        // whether the last step at the finest level was small
    NormalEquations last;  // of the last iteration
};

// Refines an estimate. models, frames: levels from fine to coarse.
void align(const ModelLevel* models, const FrameLevel* frames, int levels, const GaussNewtonSettings& settings,
           PoseEstimate& estimate);

}  // namespace semsplat
