"""Smooths the depth that the map is made of, as much as its noise asks for.

Noise is not harmless to a map: of overlapping Gaussians the nearer one hides the other, so
a noisy surface is drawn too near (3.5 mm in a room with a depth camera's noise).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# A step of this many standard deviations is an edge.
_EDGE_SIGMAS = 3.0
_REACH_PIXELS = 3
_SPATIAL_SIGMA_PIXELS = 2.0
# Noise below this is quantisation (1 / m): leave exact depth as it is.
_LEAST_NOISE = 2e-4


def inverse_depth_noise(depth_m: NDArray[np.float32]) -> float:
    """Robust standard deviation (1 / m) of the noise in inverse depth.

    A plane is linear in inverse depth, so its second differences are noise alone; and the
    noise of triangulating cameras is even in inverse depth.
    """
    left, centre, right = depth_m[:, :-2], depth_m[:, 1:-1], depth_m[:, 2:]
    valid = (left > 0) & (centre > 0) & (right > 0)
    if not valid.any():
        return 0.0
    second = 1.0 / left[valid] - 2.0 / centre[valid] + 1.0 / right[valid]
    # Median absolute value of a normal variable of variance 1 + 4 + 1.
    return float(np.median(np.abs(second))) / (0.6745 * np.sqrt(6.0))


def denoised(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [H, W] (m, 0 missing) after an edge-preserving filter fitted to its noise.

    Missing pixels stay missing; depth without noise comes back unchanged.
    """
    noise = inverse_depth_noise(depth_m)
    if noise < _LEAST_NOISE:
        return depth_m
    valid = depth_m > 0
    inverse = np.where(valid, 1.0 / np.where(valid, depth_m, 1.0), 0.0).astype(np.float32)
    # Missing pixels are 0, far outside the range that is averaged.
    smooth = cv2.bilateralFilter(
        inverse, 2 * _REACH_PIXELS + 1, _EDGE_SIGMAS * noise, _SPATIAL_SIGMA_PIXELS
    )
    return np.where(valid, 1.0 / np.where(valid, smooth, 1.0), 0.0).astype(np.float32)
