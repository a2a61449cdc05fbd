"""Pixels of a camera whose intrinsics differ from the stated ones, and derivatives of residuals.

Intrinsics [4] are those of `intrinsics.IntrinsicsEstimate`. Pixels are in stated focal lengths,
from the stated principal point, and points are on the plane at depth 1. Both are [2, N]. The slope
[2, N] of a function consists of its derivatives by the pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def distorted(points: Array, values: Array) -> Array:
    """Pixels of points."""
    stretch, _ = _stretch(points, values)
    return np.asarray(stretch * points + values[1:3, None])


def undistorted(pixels: Array, values: Array) -> Array:
    """Points of pixels."""
    bent = (pixels - values[1:3, None]) / np.exp(values[0])
    points = bent
    for _ in range(4):
        points = bent / (1.0 + values[3] * _dot(points, points))
    return points


def _by_points(points: Array, values: Array, slope: Array, inverse: bool = False) -> Array:
    """Derivatives [2, N] of a function by points; by pixels, of those by points, if inverse."""
    a, b = _stretch(points, values)
    if inverse:
        a, b = 1.0 / a, -b / (a * (a + b * _dot(points, points)))
    return np.asarray(a * slope + b * _dot(points, slope) * points)


def _by_values(points: Array, values: Array, slope: Array) -> Array:
    """Derivatives [4, N] of a function by the intrinsics, for constant points."""
    stretch, _ = _stretch(points, values)
    along = _dot(points, slope)
    return np.stack([stretch * along, *slope, np.exp(values[0]) * _dot(points, points) * along])


def _stretch(points: Array, values: Array) -> tuple[Array, Array]:
    """a [N] and b: pixels of points p are a p + c, and their derivatives a I + b p p'."""
    scale, k1 = np.exp(values[0]), values[3]
    return scale * (1.0 + k1 * _dot(points, points)), 2.0 * scale * k1


def _dot(a: Array, b: Array) -> Array:
    """Products [N] of vectors [2, N]."""
    return a[0] * b[0] + a[1] * b[1]


def derivatives(
    rays: Array, points: Array, by_rays: Array, values: Array, slope: Array, by_depth: float
) -> Array:
    """Derivatives [12, N] of a residual by pose, exposure (0 here) and intrinsics.

    Args:
        rays, points: [2, N] on the plane at depth 1 of the first camera, [3, N] in the second one.
        by_rays: [3, 2, N] derivatives of the points by the rays.
        slope: [2, N] derivatives of the residual by the pixel in the second image.
        by_depth: its derivative by the depth of the point in the second camera.
    """
    x, y, z = points
    seen = points[:2] / z
    n_x, n_y = _by_points(seen, values, slope) / z
    n_z = by_depth - (n_x * x + n_y * y) / z
    J = np.zeros((12, len(z)))
    J[0], J[1], J[2] = n_x, n_y, n_z
    J[3], J[4], J[5] = y * n_z - z * n_y, z * n_x - x * n_z, x * n_y - y * n_x
    # The pixel in the first image is constant: its ray changes with the intrinsics.
    by_first = _by_points(rays, values, (by_rays * J[:3, None]).sum(axis=0), inverse=True)
    J[8:] = _by_values(seen, values, slope) - _by_values(rays, values, by_first)
    return J
