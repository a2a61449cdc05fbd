"""Exposure of a frame against the map: map intensity = gain * frame intensity + bias."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Places of gain and bias in the normal equations [8].
GAIN, BIAS = 6, 7

# Share of the pixels that hold gain and bias where they were in the last frame.
PRIOR = 0.02


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
