"""The Gaussian that a ray hits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.viewer.scene import ShownSplats

_NEAR_M = 0.05
# Angle of a pixel of a common screen, so that Gaussians smaller than a pixel can be hit.
_PIXEL_RAD = 0.0006
# Gaussians end at this squared number of standard deviations, and at the smallest visible opacity.
_MAX_SQUARED = 11.0
_MIN_ALPHA = 1.0 / 255.0


def pick(
    splats: ShownSplats, origin_m: NDArray[np.float64], direction: NDArray[np.float64]
) -> int | None:
    """Return the Gaussian at which the light has lost half of its strength along a ray.

    Args:
        splats: the Gaussians.
        origin_m: [3] start of the ray, in the frame of the map.
        direction: [3] direction of the ray, of any length > 0.

    Returns:
        Index of the Gaussian; None if the ray ends in the background.
    """
    direction = direction / np.linalg.norm(direction)
    offsets_m = splats.means_m - origin_m
    along_m = offsets_m @ direction
    index = np.flatnonzero(along_m > _NEAR_M)
    along_m = along_m[index]
    across = (offsets_m[index] ** 2).sum(axis=1) - along_m**2
    variance = splats.sigmas_m[index] ** 2 + (_PIXEL_RAD * along_m) ** 2
    squared = across / variance
    hit = squared <= _MAX_SQUARED
    index, along_m, squared = index[hit], along_m[hit], squared[hit]
    alpha = splats.opacities[index] * np.exp(-0.5 * squared)
    visible = alpha >= _MIN_ALPHA
    order = np.argsort(along_m[visible], kind="stable")
    index, alpha = index[visible][order], alpha[visible][order]
    light = np.cumprod(1.0 - alpha)
    below = np.flatnonzero(light < 0.5)
    return int(index[below[0]]) if len(below) else None
