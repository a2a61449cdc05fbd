// Normal equations of dense frame-to-model alignment.
#pragma once

#include "alignment/levels.hpp"

namespace semsplat {

struct AlignmentSettings {
    double T_model_frame[12];
    double gain, bias;          // model intensity = gain * frame intensity + bias
    double sigma_intensity;     // scale of the photometric residual
    double sigma_depth;         // scale of the point-to-plane residual at 1 m, in m
    double max_distance;        // maximum depth difference, as a fraction of depth
    double photometric_weight;  // weight of the photometric relative to the geometric term
};

enum { PARAMETERS = 8, NORMAL_SIZE = 36 };  // translation, rotation, gain, bias

struct NormalEquations {
    double H[NORMAL_SIZE];  // upper triangle, row by row
    double g[PARAMETERS];
    double intensity_pixels, depth_pixels;    // numbers of residuals
    double intensity_squares, depth_squares;  // sums of weight * squared residual
    double frame_pixels;                      // frame pixels with depth that project into the model's image
};

// Accumulates the normal equations. The cameras of model and frame can differ.
void accumulate(const ModelLevel& model, const FrameLevel& frame, const AlignmentSettings& settings,
                NormalEquations& out);

}  // namespace semsplat
