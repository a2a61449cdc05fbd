"""Exposure of an image relative to another or to a map, from means and deviations of intensities.

Gain and bias are also part of the alignment's normal equations, but their least-squares estimates
are biased: a map is slightly smoother than the camera's image and the image is noisy, so that the
gain is too low and the bias too high. This does not affect the pose. The exposure of a frame is
therefore computed from mean and standard deviation, which are symmetric in the two images.

That of a keyframe decides the colours of the map and must not depend on the map at all, see
`exposure_between_images`: where the map is too smooth even at the coarsest level, the contrast of
each keyframe would become that of the map. In 1,100 frames of two rooms of 160x120 pixels, gains
wandered between 0.8 and 1.25 and biases up to 0.15, and the camera slid along walls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.splatting.alignment.backend import linearise
from toolkit.splatting.alignment.data import FrameLevel, LevelProblem, ModelLevel, ResidualScales
from toolkit.splatting.alignment.gauss_newton import BIAS, GAIN

# Smaller changes of contrast are ignored, because noise and smoothness change the contrast too.
# Automatic exposure causes larger ones: 16 % on RedKitchen and on fr1_rpy.
_MIN_CONTRAST_CHANGE = 0.05
# Images of the same camera are equally smooth. Their contrasts, relative to the brightness, differ
# by 0.3 % in a noisy room with varying exposure, and by 0.8 % per 6 frames of RedKitchen.
_MIN_CONTRAST_CHANGE_OF_IMAGES = 0.02
# Maximum bias between images. Biases of cameras with automatic exposure are below it (RedKitchen,
# fr1_rpy); tone mapping of parts of images causes larger ones, which add up along keyframes.
_MAX_BIAS_OF_IMAGES = 0.04
# Later keyframes refer to one whose small change was ignored, so that ignored changes add up.
_MIN_BRIGHTNESS_CHANGE_OF_IMAGES = 0.003
# Smaller changes of brightness are ignored: in 300 frames of a room with constant light the
# estimates vary by 1.4 %.
_MIN_BRIGHTNESS_CHANGE = 0.02
# Minimum mean and deviation from which a gain can be estimated.
_MIN_MEAN, _MIN_DEVIATION = 0.02, 0.01
# Minimum number of pixels of a level.
_MIN_PIXELS = 50
# Minimum number of common surface cells of images, and their minimum intensity.
_MIN_CELLS, _MIN_INTENSITY = 250, 0.03
# Maximum deviation of a cell from the median ratio, in logarithms: further ones are highlights,
# moving objects and edges.
_MAX_DEVIATION = 0.3


@dataclass(frozen=True)
class IntensityStatistics:
    """Mean and standard deviation of intensities."""

    mean: float
    deviation: float

    @classmethod
    def of(cls, intensities: NDArray[np.float64]) -> IntensityStatistics:
        """Statistics of an array."""
        return cls(float(intensities.mean()), float(intensities.std()))


def exposure_between(
    frame: IntensityStatistics,
    model: IntensityStatistics,
    min_contrast_change: float = _MIN_CONTRAST_CHANGE,
) -> Exposure:
    """Exposure of a frame against a model of the same surface.

    The gain is the ratio of the means and the bias is 0, unless the contrasts differ by more than
    a fraction `min_contrast_change`.
    """
    if min(frame.mean, model.mean) < _MIN_MEAN:
        return IDENTITY
    ratio = model.mean / frame.mean
    if min(frame.deviation, model.deviation) < _MIN_DEVIATION:
        return Exposure(ratio)
    gain = model.deviation / frame.deviation
    if abs(gain / ratio - 1.0) < min_contrast_change:
        return Exposure(ratio)
    return Exposure(gain, model.mean - gain * frame.mean)


def exposure_between_images(
    reference: NDArray[np.float64], image: NDArray[np.float64]
) -> Exposure | None:
    """Exposure of an image against others, from intensities [P] of the same surface cells.

    Args:
        reference: intensities in other images, at the exposure of the map.
        image: intensities as observed.

    Returns:
        The exposure; None if too few cells determine it.
    """
    bright = np.minimum(reference, image) > _MIN_INTENSITY
    reference, image = reference[bright], image[bright]
    for _ in range(2):
        if len(image) < _MIN_CELLS:
            return None
        ratios = np.log(reference / image)
        near = np.abs(ratios - np.median(ratios)) < _MAX_DEVIATION
        reference, image = reference[near], image[near]
    if len(image) < _MIN_CELLS:
        return None
    new, old = IntensityStatistics.of(image), IntensityStatistics.of(reference)
    exposure = exposure_between(new, old, _MIN_CONTRAST_CHANGE_OF_IMAGES)
    if abs(exposure.bias) > _MAX_BIAS_OF_IMAGES:
        bias = math.copysign(_MAX_BIAS_OF_IMAGES, exposure.bias)
        exposure = Exposure((old.mean - bias) / new.mean, bias)
    return _if_significant(exposure, _MIN_BRIGHTNESS_CHANGE_OF_IMAGES)


def _if_significant(exposure: Exposure, min_change: float = _MIN_BRIGHTNESS_CHANGE) -> Exposure:
    """The exposure, or the identity for a small change of brightness."""
    unchanged = exposure.bias == 0.0 and abs(exposure.gain - 1.0) < min_change
    return IDENTITY if unchanged else exposure


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
        return _if_significant(exposure_between(*(again or found)))
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
    gate = max_distance * 2**level
    linear = linearise(LevelProblem(*levels[level], T_view_camera, scales, exposure, gate))
    if linear.intensity_pixels < _MIN_PIXELS:
        return None
    squares = linear.intensity_variance * linear.intensity_pixels
    return intensity_statistics(linear.H, linear.g, squares, exposure)
