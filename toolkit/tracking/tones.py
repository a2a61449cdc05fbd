"""Exposure by brightness and contrast: what the map is told of a frame, and submaps of each other.

Gain and bias of the alignment's equations are part of its fit: a map is a little smoother than
the camera's image, and the image noisy, so least squares find the gain below and the bias above
their true values. For the motion that does no harm. Given to the map with the next keyframe it
grows: after 900 frames of a ring of rooms a fifth of the contrast was left. What the map is told
comes from brightness and contrast of both instead, in which both count alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.tracking.alignment import FrameLevel, ModelLevel, Scales, linearise
from toolkit.tracking.exposure import BIAS, GAIN

# Contrasts that differ by less are taken for equal, since noise and smoothness make a difference
# too. Automatic exposure does more: 16 % on RedKitchen and on fr1_rpy.
_EQUAL_CONTRAST = 0.05
# A frame brighter or darker by less has the map's exposure: what is told wanders by 1.4 % in 300
# frames of a room whose light never changes.
_EQUAL_BRIGHTNESS = 0.02
# Intensities below it, on average or about their mean, tell no factor.
_DARKEST, _FLATTEST = 0.02, 0.01
# Fewer pixels of a level tell nothing.
_FEWEST_PIXELS = 50


@dataclass(frozen=True)
class Tones:
    """Mean of intensities, and their standard deviation."""

    mean: float
    spread: float


def exposure_between(frame: Tones, model: Tones) -> tuple[float, float]:
    """Gain and bias that give a frame the tones of a model of the same things.

    A factor alone, by the means, unless the contrasts say otherwise.
    """
    if min(frame.mean, model.mean) < _DARKEST:
        return 1.0, 0.0
    factor = model.mean / frame.mean
    if min(frame.spread, model.spread) < _FLATTEST:
        return factor, 0.0
    gain = model.spread / frame.spread
    if abs(gain / factor - 1.0) < _EQUAL_CONTRAST:
        return factor, 0.0
    return gain, model.mean - gain * frame.mean


def tones(
    H: NDArray[np.float64], g: NDArray[np.float64], squares: float, exposure: tuple[float, float]
) -> tuple[Tones, Tones]:
    """Tones of the frame and of the view that it was held against, from normal equations.

    Args:
        H: [8, 8], g: [8] at some pose and exposure. squares: sum of weighted squared
            intensity residuals, view - (gain * frame + bias), weighted as in H.
        exposure: gain and bias there.
    """
    (gain, bias), weight = exposure, float(H[BIAS, BIAS])
    if weight <= 0.0:
        return Tones(0.0, 0.0), Tones(0.0, 0.0)
    mean = float(H[GAIN, BIAS]) / weight
    variance = float(H[GAIN, GAIN]) / weight - mean**2
    # The residual's derivatives by gain and bias are -intensity and -1.
    residual = -float(g[BIAS]) / weight
    together = -float(g[GAIN]) / weight - mean * residual
    of_view = gain**2 * variance + 2.0 * gain * together + squares / weight - residual**2
    frame = Tones(mean, max(variance, 0.0) ** 0.5)
    return frame, Tones(gain * mean + bias + residual, max(of_view, 0.0) ** 0.5)


def told_exposure(
    levels: Sequence[tuple[ModelLevel, FrameLevel]],
    T_view_camera: NDArray[np.float64],
    scales: Scales,
    fitted: tuple[float, float],
    max_distance: float,
) -> tuple[float, float]:
    """Gain and bias of an aligned frame, by the coarsest level that has pixels enough.

    There neither noise nor smoothness says much. Weights follow from the exposure, so it is told
    twice.

    Args:
        levels: view and frame, from fine to coarse. fitted: exposure to begin with.
        max_distance: gate on depth differences at the finest level, as a share of depth.
    """
    for level in reversed(range(len(levels))):
        found = _tones_at(levels, level, T_view_camera, scales, fitted, max_distance)
        if found is None:
            continue
        told = exposure_between(*found)
        again = _tones_at(levels, level, T_view_camera, scales, told, max_distance)
        gain, bias = exposure_between(*(again or found))
        unchanged = bias == 0.0 and abs(gain - 1.0) < _EQUAL_BRIGHTNESS
        return (1.0, 0.0) if unchanged else (gain, bias)
    return 1.0, 0.0


def _tones_at(
    levels: Sequence[tuple[ModelLevel, FrameLevel]],
    level: int,
    T_view_camera: NDArray[np.float64],
    scales: Scales,
    exposure: tuple[float, float],
    max_distance: float,
) -> tuple[Tones, Tones] | None:
    """Tones of frame and view on one level, None where too few pixels have both."""
    gate = max_distance * 2**level
    linear = linearise(*levels[level], T_view_camera, scales, exposure, gate)
    if linear.intensity_pixels < _FEWEST_PIXELS:
        return None
    squares = linear.intensity_variance * linear.intensity_pixels
    return tones(linear.H, linear.g, squares, exposure)
