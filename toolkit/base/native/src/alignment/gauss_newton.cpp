// Gauss-Newton in double precision around the normal equations. alignment/gauss_newton.py is its
// reference.

#include "alignment/gauss_newton.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "common/constants.hpp"
#include "common/se3.hpp"

namespace semsplat {
namespace {

enum { GAIN = 6, BIAS = 7 };

struct System {
    double H[PARAMETERS][PARAMETERS];
    double g[PARAMETERS];
};

System unpacked(const NormalEquations& equations) {
    System system;
    const double* from = equations.H;
    for (int i = 0; i < PARAMETERS; ++i) {
        for (int j = i; j < PARAMETERS; ++j) system.H[i][j] = system.H[j][i] = *from++;
        system.g[i] = equations.g[i];
    }
    return system;
}

void fix_exposure(System& system) {
    for (int k : {GAIN, BIAS}) {
        for (int i = 0; i < PARAMETERS; ++i) system.H[i][k] = system.H[k][i] = 0;
        system.g[k] = 0;
    }
    system.H[GAIN][GAIN] = system.H[BIAS][BIAS] = 1;
}

void add_prior(System& system, int k, double information, double change) {
    const double prior = EXPOSURE_PRIOR * information;
    system.H[k][k] += prior;
    system.g[k] += prior * change;
}

// Solves H x = -g with slight damping, by elimination with row pivoting. False if H is singular.
bool solve(System& system, double (&x)[PARAMETERS]) {
    auto& H = system.H;
    for (int i = 0; i < PARAMETERS; ++i) {
        H[i][i] *= 1 + SOLVER_DAMPING;
        x[i] = -system.g[i];
    }
    for (int k = 0; k < PARAMETERS; ++k) {
        int pivot = k;
        for (int i = k + 1; i < PARAMETERS; ++i) {
            if (std::fabs(H[i][k]) > std::fabs(H[pivot][k])) pivot = i;
        }
        if (!(std::fabs(H[pivot][k]) > 0)) return false;
        std::swap(H[k], H[pivot]);
        std::swap(x[k], x[pivot]);
        for (int i = k + 1; i < PARAMETERS; ++i) {
            const double factor = H[i][k] / H[k][k];
            for (int j = k + 1; j < PARAMETERS; ++j) H[i][j] -= factor * H[k][j];
            x[i] -= factor * x[k];
        }
    }
    bool finite = true;
    for (int k = PARAMETERS - 1; k >= 0; --k) {
        for (int j = k + 1; j < PARAMETERS; ++j) x[k] -= H[k][j] * x[j];
        x[k] /= H[k][k];
        finite = finite && std::isfinite(x[k]);
    }
    return finite;
}

// The step, or false if there are too few residuals or H is singular.
bool step_of(const NormalEquations& equations, const PoseEstimate& estimate, const GaussNewtonSettings& settings,
             bool finest, double (&step)[PARAMETERS]) {
    if (equations.depth_pixels + equations.intensity_pixels < settings.min_pixels) return false;
    System system = unpacked(equations);
    if (settings.adjust_exposure && finest) {
        const double sigma = estimate.sigma_intensity;
        const double information = settings.photometric_weight * equations.intensity_pixels / (sigma * sigma);
        add_prior(system, GAIN, information, estimate.gain - settings.prior_gain);
        add_prior(system, BIAS, information, estimate.bias - settings.prior_bias);
    } else {
        fix_exposure(system);
    }
    return solve(system, step);
}

// One fixed-point iteration for the scale of Student's t distribution.
double rescaled(double scale, double squares, double pixels, double low, double high) {
    if (!(pixels > 0)) return scale;
    return std::min(std::max(scale * std::sqrt(squares / std::max(pixels, 1.0)), low), high);
}

bool is_small(const double* step, const GaussNewtonSettings& settings, int level) {
    const double factor = std::ldexp(1.0, 2 * level);
    return std::hypot(step[0], step[1], step[2]) < settings.min_translation * factor &&
           std::hypot(step[3], step[4], step[5]) < settings.min_rotation * factor;
}

}  // namespace

void align(const ModelLevel* models, const FrameLevel* frames, int levels, const GaussNewtonSettings& settings,
           PoseEstimate& estimate) {
    AlignmentSettings linear;
    linear.photometric_weight = settings.photometric_weight;
    for (int level = levels - 1; level >= 0; --level) {
        linear.max_distance = std::ldexp(settings.max_distance, level);
        estimate.converged = false;
        for (int done = 0; done < settings.iterations && !estimate.converged; ++done) {
            std::copy(estimate.T_model_frame, estimate.T_model_frame + 12, linear.T_model_frame);
            linear.gain = estimate.gain;
            linear.bias = estimate.bias;
            linear.sigma_intensity = estimate.sigma_intensity;
            linear.sigma_depth = estimate.sigma_depth;
            NormalEquations& last = estimate.last;
            accumulate(models[level], frames[level], linear, last);
            ++estimate.iterations;
            double step[PARAMETERS];
            if (!step_of(last, estimate, settings, level == 0, step)) return;
            move(step, estimate.T_model_frame);
            estimate.gain += step[GAIN];
            estimate.bias += step[BIAS];
            estimate.sigma_intensity = rescaled(estimate.sigma_intensity, last.intensity_squares,
                                                last.intensity_pixels, MIN_INTENSITY_SCALE, MAX_INTENSITY_SCALE);
            estimate.sigma_depth = rescaled(estimate.sigma_depth, last.depth_squares, last.depth_pixels,
                                            MIN_DEPTH_SCALE, MAX_DEPTH_SCALE);
            estimate.converged = is_small(step, settings, level);
        }
    }
}

}  // namespace semsplat
