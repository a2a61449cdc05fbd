// Constants shared with Python. Their values are defined in toolkit/base/native/constants.py and passed
// by setup.py.
#pragma once

namespace semsplat {

enum {
    DEPTH_SUM = SEMSPLAT_DEPTH_SUM,
    SILHOUETTE = SEMSPLAT_SILHOUETTE,
    BASE_CHANNELS = SEMSPLAT_BASE_CHANNELS,
    TILE = SEMSPLAT_TILE,
    SSIM_WINDOW = SEMSPLAT_SSIM_WINDOW,
    ALIGNMENT_SUMS = SEMSPLAT_ALIGNMENT_SUMS,
};

constexpr float NEAR_M = (float)SEMSPLAT_NEAR_M;
constexpr float MIN_ALPHA = (float)SEMSPLAT_MIN_ALPHA;
constexpr float MAX_ALPHA = (float)SEMSPLAT_MAX_ALPHA;
constexpr float MIN_TRANSMITTANCE = (float)SEMSPLAT_MIN_TRANSMITTANCE;
constexpr float MIN_SIGMA_PX = (float)SEMSPLAT_MIN_SIGMA_PX;

constexpr float MAX_DEPTH_STEP = (float)SEMSPLAT_MAX_DEPTH_STEP;
constexpr float MAX_SURFACE_CORRECTION = (float)SEMSPLAT_MAX_SURFACE_CORRECTION;
constexpr float MIN_NORMAL = (float)SEMSPLAT_MIN_NORMAL;
constexpr float MAX_CENTRE_OFFSET_PX = (float)SEMSPLAT_MAX_CENTRE_OFFSET_PX;
constexpr float MIN_CENTRE_DEPTH_M = (float)SEMSPLAT_MIN_CENTRE_DEPTH_M;

constexpr float LUMA_RED = (float)SEMSPLAT_LUMA_RED;
constexpr float LUMA_GREEN = (float)SEMSPLAT_LUMA_GREEN;
constexpr float LUMA_BLUE = (float)SEMSPLAT_LUMA_BLUE;
constexpr float STUDENT_T_DOF = (float)SEMSPLAT_STUDENT_T_DOF;
constexpr double EXPOSURE_PRIOR = SEMSPLAT_EXPOSURE_PRIOR;
constexpr double SOLVER_DAMPING = SEMSPLAT_SOLVER_DAMPING;
constexpr double MIN_INTENSITY_SCALE = SEMSPLAT_MIN_INTENSITY_SCALE;
constexpr double MAX_INTENSITY_SCALE = SEMSPLAT_MAX_INTENSITY_SCALE;
constexpr double MIN_DEPTH_SCALE = SEMSPLAT_MIN_DEPTH_SCALE;
constexpr double MAX_DEPTH_SCALE = SEMSPLAT_MAX_DEPTH_SCALE;

constexpr double SSIM_SIGMA_PX = SEMSPLAT_SSIM_SIGMA_PX;
constexpr float SSIM_K1 = (float)SEMSPLAT_SSIM_K1;
constexpr float SSIM_K2 = (float)SEMSPLAT_SSIM_K2;

constexpr float MIN_NOISE_DEPTH_M = (float)SEMSPLAT_MIN_NOISE_DEPTH_M;
constexpr double MIN_PLANE_DETERMINANT = SEMSPLAT_MIN_PLANE_DETERMINANT;

}  // namespace semsplat
