"""Constants of the C++ kernels and their counterparts in Python and Triton.

This module is their only definition. `setup.py` executes it and passes each value to the compiler
as the macro SEMSPLAT_NAME, which `src/common/constants.hpp` turns into a C++ constant. Variants
that were compiled with other values are not loaded.
"""

# Rendered images [5 + S, H, W]: red, green, blue, depth sum, silhouette, then S features.
DEPTH_SUM = 3
SILHOUETTE = 4
BASE_CHANNELS = 5

# Compositing.
TILE = 16  # side length of a tile in pixels; regions are masks of tiles
NEAR_M = 0.01  # nearer Gaussians and points are ignored
MIN_ALPHA = 1.0 / 255.0  # smaller contributions are ignored
MAX_ALPHA = 0.999  # keeps 1 / (1 - alpha) finite
MIN_TRANSMITTANCE = 1e-4  # compositing of a block of pixels stops below this value
MIN_SIGMA_PX = 1e-6  # smaller Gaussians are ignored; their squares would underflow

# The surface of a rendered view: planes through the mean centre of each pixel's Gaussians.
MAX_DEPTH_STEP = 0.05  # larger relative depth differences are edges, except on one plane
MAX_SURFACE_CORRECTION = 0.1  # relative correction of the mean depth; steep walls need above 0.02
# Minimum length of a normal as a fraction of a pixel's footprint. The mean centre of large
# Gaussians is nearly constant over neighbouring pixels and does not define a plane.
MIN_NORMAL = 0.01
MAX_CENTRE_OFFSET_PX = 1.0  # between a pixel and its mean centre; larger offsets are edges
MIN_CENTRE_DEPTH_M = 0.05

# Dense alignment.
LUMA_RED = 0.299
LUMA_GREEN = 0.587
LUMA_BLUE = 0.114
STUDENT_T_DOF = 5.0  # degrees of freedom of the residuals' distribution
EXPOSURE_PRIOR = 0.02  # weight of the prior on the exposure relative to the photometric residuals
SOLVER_DAMPING = 1e-6  # relative increase of the diagonal of the normal equations
# Range of the re-estimated scales: intensities in [0, 1], metres at a depth of 1 m.
MIN_INTENSITY_SCALE = 0.002
MAX_INTENSITY_SCALE = 0.2
MIN_DEPTH_SCALE = 0.0001
MAX_DEPTH_SCALE = 0.05
ALIGNMENT_SUMS = 49  # sums of one linearisation: H [36, upper triangle], g [8] and 5 counts

# SSIM.
SSIM_WINDOW = 11  # pixels per side of the Gaussian window
SSIM_SIGMA_PX = 1.5
SSIM_K1 = 0.01
SSIM_K2 = 0.03

# Depth.
MIN_NOISE_DEPTH_M = 0.5  # depth noise grows with the squared depth from here on
MIN_PLANE_DETERMINANT = 1e-6  # of a plane fit, relative to the product of the matrix diagonal


def values() -> dict[str, float]:
    """All constants by name."""
    return {name: value for name, value in globals().items() if name.isupper()}


def fingerprint() -> str:
    """All names and values as one line, which a compiled variant stores."""
    return " ".join(f"{name}={value!r}" for name, value in sorted(values().items()))
