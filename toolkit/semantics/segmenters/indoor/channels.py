"""What the indoor network sees: shape in the frame of gravity, without colour."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid

COUNT = 8

# Side lengths in cells of the windows against whose mean the inverse depth is compared.
_NARROW, _WIDE = 9, 41
# Scale of heights, and extent of a cell that becomes 0, both in metres.
_HEIGHT_M, _CELL_M = 1.5, 0.02
# Fraction of the cells with depth below which the floor is assumed where none is known.
_LOWEST = 0.01


def indoor_channels(
    grid: SurfaceGrid, up_camera: NDArray[np.float64], floor_m: float | None
) -> NDArray[np.float32]:
    """Compute the input [8, h, w] of the network.

    Args:
        grid: the cells in camera coordinates.
        up_camera: [3] unit vector, up in camera coordinates.
        floor_m: height of the floor above the camera along up (negative), None if it is unknown.

    Returns:
        height above the floor, cosine of the normal to up and to the ray, size of a cell in metres
        (logarithmic), inverse depth relative to its means over two windows, and the masks of cells
        with depth and with a normal.
    """
    up = up_camera.astype(np.float32)
    heights = grid.points @ up
    if floor_m is None:
        known = heights[grid.valid]
        floor_m = float(np.quantile(known, _LOWEST)) if known.size else 0.0
    rays = np.stack([grid.x, grid.y, np.ones_like(grid.x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    oriented = grid.oriented.astype(np.float32)
    valid = grid.valid.astype(np.float32)
    size = np.log2(np.maximum(grid.depth_m, 0.05) * np.float32(grid.cell_area**0.5) / _CELL_M)
    out = np.stack(
        [
            np.clip((heights - np.float32(floor_m)) / _HEIGHT_M - 0.5, -1.5, 2.0),
            (grid.normals @ up) * oriented,
            -np.einsum("hwc,hwc->hw", grid.normals, rays) * oriented - 0.7,
            size / 2.0,
            8.0 * np.clip(_contrast(grid.inverse_depth, valid, _NARROW), -0.25, 0.25),
            3.0 * _contrast(grid.inverse_depth, valid, _WIDE),
            valid,
            oriented,
        ]
    )
    out[:6] *= valid
    return np.asarray(out, dtype=np.float32)


def _contrast(
    inverse_depth: NDArray[np.float32], valid: NDArray[np.float32], side: int
) -> NDArray[np.float32]:
    """Inverse depth [h, w] relative to its mean over a window, from -1 to 1."""
    border = cv2.BORDER_CONSTANT
    total = cv2.boxFilter(inverse_depth, -1, (side, side), normalize=False, borderType=border)
    count = cv2.boxFilter(valid, -1, (side, side), normalize=False, borderType=border)
    mean = total / np.maximum(count, 1.0)
    ratio = inverse_depth / np.maximum(mean, 1e-6) - 1.0
    return np.asarray(np.clip(ratio, -1.0, 1.0), dtype=np.float32)
