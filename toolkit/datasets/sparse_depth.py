"""Depth in single pixels or lines, of projectors in sunlight, dark surfaces or LiDAR, made dense.

Normals, alignment and the growth of a map need neighbours with depth. Between samples of one
surface, depth follows from a plane: in image coordinates, the inverse depth of a plane is linear,
so that a weighted regression over a window is exact on it. Where a window contains several
surfaces, or samples on one side only, nothing is filled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# Depth is sparse if more than this share of the pixels with depth lacks a direct neighbour with
# depth, in general and where gaps are single pixels. Connected depth has 0.02 to 0.05, and 0.3 with
# holes of many pixels (HoloLens); 90 % of the pixels at random have 0.34, half of them 0.94.
_MAX_LONELY, _MAX_SPECKLED = 0.5, 0.15
# Windows that span gaps of single pixels.
_SPECKLE_PX = 2.0
# Pixels farther than this from depth show something that was not measured at all.
_MAX_GAP_PX = 24.0
# Largest residual of one surface, relative to its inverse depth, and largest offset of the centre
# of the samples from the pixel, in standard deviations of the window.
_MAX_RESIDUAL, _MAX_OFFSET = 0.02, 0.8
# Minimum weight of the samples in a window.
_MIN_WEIGHT = 1e-3


@dataclass(frozen=True)
class Sparsity:
    """How sparse depth is.

    Attributes:
        lonely: share of the pixels with depth that lack a direct neighbour with depth.
        covered: share of the pixels with depth.
        window_px: standard deviation of the window that spans the gaps between samples.
    """

    lonely: float
    covered: float
    window_px: float

    @property
    def is_sparse(self) -> bool:
        """Whether gaps are to be filled."""
        limit = _MAX_SPECKLED if self.window_px <= _SPECKLE_PX else _MAX_LONELY
        return self.lonely > limit


def sparsity(depths: Sequence[NDArray]) -> Sparsity:
    """Measure how sparse depth images [H, W] (0 where missing) are."""
    lonely, covered, gaps = [], [], []
    for depth in depths:
        valid = depth > 0
        if not valid.any():
            continue
        connected = valid.copy()
        connected[1:] &= valid[:-1]
        connected[:-1] &= valid[1:]
        connected[:, 1:] &= valid[:, :-1]
        connected[:, :-1] &= valid[:, 1:]
        lonely.append(1.0 - connected.sum() / valid.sum())
        covered.append(valid.mean())
        distance = cv2.distanceTransform((~valid).astype(np.uint8), cv2.DIST_L2, 3)
        near = distance[(distance > 0) & (distance < _MAX_GAP_PX)]
        gaps.append(float(np.percentile(near, 90)) if near.size else 1.0)
    if not lonely:
        return Sparsity(0.0, 0.0, 1.0)
    return Sparsity(float(np.median(lonely)), float(np.median(covered)), float(np.median(gaps)))


def filled(depth_m: NDArray[np.float32], window_px: float) -> NDArray[np.float32]:
    """Depth [H, W] with the gaps between samples of one surface filled; samples stay.

    Args:
        depth_m: 0 where missing.
        window_px: standard deviation of the largest window.
    """
    valid = depth_m > 0
    result = depth_m.copy()
    for sigma_px in (0.5 * window_px, window_px):
        inverse = np.where(valid, 1.0 / np.where(valid, depth_m, 1.0), 0.0)
        estimate, usable = _plane(inverse, valid, max(sigma_px, 0.7))
        missing = (result == 0) & usable
        result[missing] = (1.0 / estimate[missing]).astype(np.float32)
    return result


def _plane(
    inverse: NDArray[np.float64], valid: NDArray[np.bool_], sigma_px: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Inverse depth [H, W] of the plane through the samples around each pixel, and where it holds.

    Moments of a window are blurred products with coordinates, which are then centred on the pixel.
    """
    height, width = inverse.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)

    def blurred(image: NDArray[np.float64]) -> NDArray[np.float64]:
        return cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT)

    m = valid.astype(np.float64)
    weight = blurred(m)
    w = np.maximum(weight, 1e-12)
    mean_x, mean_y = blurred(m * x) / w, blurred(m * y) / w
    xx = blurred(m * x * x) / w - mean_x**2
    yy = blurred(m * y * y) / w - mean_y**2
    xy = blurred(m * x * y) / w - mean_x * mean_y
    mean = blurred(inverse) / w
    xd = blurred(inverse * x) / w - mean_x * mean
    yd = blurred(inverse * y) / w - mean_y * mean
    dd = blurred(inverse * inverse) / w - mean**2
    determinant = xx * yy - xy * xy
    solvable = determinant > 0.02 * sigma_px**4
    safe = np.where(solvable, determinant, 1.0)
    a, b = (yy * xd - xy * yd) / safe, (xx * yd - xy * xd) / safe
    estimate = mean + a * (x - mean_x) + b * (y - mean_y)
    residual = np.sqrt(np.maximum(dd - a * xd - b * yd, 0.0))
    offset = np.hypot(x - mean_x, y - mean_y)
    usable = solvable & (weight > _MIN_WEIGHT) & (offset < _MAX_OFFSET * sigma_px)
    usable &= (estimate > 0) & (residual < _MAX_RESIDUAL * estimate)
    return estimate, usable
