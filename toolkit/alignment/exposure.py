"""Exposure of one image relative to another, from the mean and deviation of their intensities.

Gain and bias are also part of the alignment's normal equations, but their least-squares estimates
are biased: a map is slightly smoother than the camera's image and the image is noisy, so that the
gain is too low and the bias too high. This does not affect the pose. If it were stored with the
keyframes, it would accumulate: after 900 frames of a ring of rooms only a fifth of the contrast
remained. The exposure that is stored with a keyframe is therefore computed from mean and standard
deviation, which are symmetric in the two images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.backend import linearise
from toolkit.alignment.data import FrameLevel, ModelLevel, ResidualScales
from toolkit.alignment.normal_equations import BIAS, GAIN
from toolkit.exposure import IDENTITY, Exposure

# Smaller changes of contrast are ignored, because noise and smoothness change the contrast too.
# Automatic exposure causes larger ones: 16 % on RedKitchen and on fr1_rpy.
_MIN_CONTRAST_CHANGE = 0.05
# Smaller changes of brightness are ignored: in 300 frames of a room with constant light the
# estimates vary by 1.4 %.
_MIN_BRIGHTNESS_CHANGE = 0.02
# Minimum mean and deviation from which a gain can be estimated.
_MIN_MEAN, _MIN_DEVIATION = 0.02, 0.01
# Minimum number of pixels of a level.
_MIN_PIXELS = 50


@dataclass(frozen=True)
class IntensityStatistics:
    """Mean and standard deviation of intensities."""

    mean: float
    deviation: float


def exposure_between(frame: IntensityStatistics, model: IntensityStatistics) -> Exposure:
    """Exposure of a frame against a model of the same surface.

    The gain is the ratio of the means and the bias is 0, unless the contrasts differ significantly.
    """
    if min(frame.mean, model.mean) < _MIN_MEAN:
        return IDENTITY
    ratio = model.mean / frame.mean
    if min(frame.deviation, model.deviation) < _MIN_DEVIATION:
        return Exposure(ratio)
    gain = model.deviation / frame.deviation
    if abs(gain / ratio - 1.0) < _MIN_CONTRAST_CHANGE:
        return Exposure(ratio)
    return Exposure(gain, model.mean - gain * frame.mean)


def intensity_statistics(
    H: NDArray[np.float64], g: NDArray[np.float64], squares: float, exposure: Exposure
) -> tuple[IntensityStatistics, IntensityStatistics]:
    """Statistics of a frame and of the view it was aligned to, from normal equations.

    Args:
        H: [8, 8], g: [8] at some pose and exposure.
        squares: sum of the weighted squared residuals, view - (gain * frame + bias), weighted as
            in H.
        exposure: exposure at which the equations were linearised.
    """
    gain, bias, weight = exposure.gain, exposure.bias, float(H[BIAS, BIAS])
    if weight <= 0.0:
        return IntensityStatistics(0.0, 0.0), IntensityStatistics(0.0, 0.0)
    mean = float(H[GAIN, BIAS]) / weight
    variance = float(H[GAIN, GAIN]) / weight - mean**2
    # The residual's derivatives with respect to gain and bias are -intensity and -1.
    residual = -float(g[BIAS]) / weight
    covariance = -float(g[GAIN]) / weight - mean * residual
    view_variance = gain**2 * variance + 2.0 * gain * covariance + squares / weight - residual**2
    frame = IntensityStatistics(mean, max(variance, 0.0) ** 0.5)
    view_mean = gain * mean + bias + residual
    return frame, IntensityStatistics(view_mean, max(view_variance, 0.0) ** 0.5)


def estimate_exposure(
    levels: Sequence[tuple[ModelLevel, FrameLevel]],
    T_view_camera: NDArray[np.float64],
    scales: ResidualScales,
    fitted: Exposure,
    max_distance: float,
) -> Exposure:
    """Exposure of an aligned frame, from the coarsest level with enough pixels.

    Noise and smoothness have the smallest influence there. The robust weights depend on the
    exposure, so it is estimated twice.

    Args:
        levels: view and frame, from fine to coarse.
        T_view_camera: [4, 4] pose of the frame in the view's coordinates.
        fitted: exposure of the alignment.
        max_distance: maximum depth difference at the finest level, as a fraction of depth.
    """
    for level in reversed(range(len(levels))):
        found = _statistics_at(levels, level, T_view_camera, scales, fitted, max_distance)
        if found is None:
            continue
        first = exposure_between(*found)
        again = _statistics_at(levels, level, T_view_camera, scales, first, max_distance)
        exposure = exposure_between(*(again or found))
        unchanged = exposure.bias == 0.0 and abs(exposure.gain - 1.0) < _MIN_BRIGHTNESS_CHANGE
        return IDENTITY if unchanged else exposure
    return IDENTITY


def _statistics_at(
    levels: Sequence[tuple[ModelLevel, FrameLevel]],
    level: int,
    T_view_camera: NDArray[np.float64],
    scales: ResidualScales,
    exposure: Exposure,
    max_distance: float,
) -> tuple[IntensityStatistics, IntensityStatistics] | None:
    """Statistics of frame and view at one level; None if too few pixels correspond."""
    linear = linearise(*levels[level], T_view_camera, scales, exposure, max_distance * 2**level)
    if linear.intensity_pixels < _MIN_PIXELS:
        return None
    squares = linear.intensity_variance * linear.intensity_pixels
    return intensity_statistics(linear.H, linear.g, squares, exposure)
