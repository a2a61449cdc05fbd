"""Exposure of a frame against the map: map intensity = gain * frame intensity + bias.

Gain and bias of the alignment's equations are part of its fit: a map is a little smoother than
the camera's image, and the image noisy, so least squares find the gain below and the bias above
their true values. For the motion that does no harm. Given to the map with the next keyframe it
grows: after 900 frames of a ring of rooms a fifth of the contrast was left. What the map is told
comes from brightness and contrast of both instead, in which both count alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Places of gain and bias in the normal equations [8].
GAIN, BIAS = 6, 7

# Share of the pixels that hold gain and bias where they were in the last frame.
PRIOR = 0.02

# Contrasts that differ by less are taken for equal, since noise and smoothness make a difference
# too. Automatic exposure does more: 16 % on RedKitchen and on fr1_rpy.
_EQUAL_CONTRAST = 0.05
# Intensities below it, on average or about their mean, tell no factor.
_DARKEST, _FLATTEST = 0.02, 0.01


def hold(
    H: NDArray[np.float64], g: NDArray[np.float64], information: float, change: NDArray[np.float64]
) -> None:
    """Add to H [8, 8] and g [8] the prior that draws exposure back to the last frame's.

    It changes little between frames. Left free, gain 0 would explain any misalignment: on
    steps of 5 to 17 degrees it took the pose away by 70 cm.

    Args:
        information: of all pixels about the bias, pixels / variance.
        change: [2] gain and bias less those of the last frame.
    """
    prior = PRIOR * information
    for place, difference in zip((GAIN, BIAS), change, strict=True):
        H[place, place] += prior
        g[place] += prior * difference


def fix(H: NDArray[np.float64], g: NDArray[np.float64]) -> None:
    """Take gain and bias out of the equations, so that their steps are 0."""
    H[GAIN:, :] = 0.0
    H[:, GAIN:] = 0.0
    H[GAIN, GAIN] = H[BIAS, BIAS] = 1.0
    g[GAIN:] = 0.0


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
