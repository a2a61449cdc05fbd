"""A depth image reduced to a coarse grid of cells with points, normals and planes.

The inverse depth of a plane is linear in image coordinates, and the noise of structured light is
uniform in inverse depth. Planes are therefore fitted to inverse depth, by box filters, which takes
a few milliseconds per image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera

# Radius of the windows of the plane fits in cells; larger windows lose small surfaces.
_RADIUS = 3
# Relative depth step above which a block of pixels contains two surfaces.
_STEP = 0.06
# Minimum fraction of pixels with depth in a window and in a block.
_MIN_WINDOW, _MIN_BLOCK = 0.3, 0.4
_NO_FIT = np.float32(1e8)


@dataclass(frozen=True)
class SurfaceGrid:
    """Surfaces in camera coordinates, with one cell for each block of pixels.

    Attributes:
        block: side length of a cell in pixels.
        inverse_depth: [h, w] float32 in 1/m, 0 where missing.
        valid: [h, w], whether a cell has depth.
        x, y: [h, w] float32, intersection of a cell's ray with the plane z = 1.
        planes: [h, w, 3] float32 (a, b, c) with inverse depth = a x + b y + c around the cell.
        normals: [h, w, 3] float32 unit normals, towards the camera.
        oriented: [h, w], whether a cell has a plane and a normal.
        points: [h, w, 3] float32 in metres.
        cell_area: area of one cell on the plane z = 1.
    """

    block: int
    inverse_depth: NDArray[np.float32]
    valid: NDArray[np.bool_]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    planes: NDArray[np.float32]
    normals: NDArray[np.float32]
    oriented: NDArray[np.bool_]
    points: NDArray[np.float32]
    cell_area: float

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """z-depth [h, w] in metres, 0 where missing."""
        return self.points[..., 2]

    @property
    def areas_m2(self) -> NDArray[np.float32]:
        """Surface area [h, w] of each cell in square metres; 0 for cells without a normal."""
        x, y, z = np.moveaxis(self.normals, -1, 0)
        cosine = -(x * self.x + y * self.y + z)
        area = self.cell_area * self.depth_m**2 / np.maximum(cosine, 0.05)
        return np.where(self.oriented, area, 0)


def surface_grid(depth_m: NDArray[np.float32], camera: Camera, columns: int = 160) -> SurfaceGrid:
    """Compute the grid of a depth image.

    Args:
        depth_m: [H, W] z-depth in metres, 0 where missing.
        camera: intrinsics of the image.
        columns: maximum number of cells across the image.
    """
    block = max(1, -(-camera.width // columns))
    block = min(block, camera.height)
    inverse_depth, valid = _reduced(depth_m, block)
    height, width = inverse_depth.shape
    middle = (block - 1) / 2
    across = (np.arange(width) * block + middle - camera.cx) / camera.fx
    down = (np.arange(height) * block + middle - camera.cy) / camera.fy
    x, y = np.meshgrid(across.astype(np.float32), down.astype(np.float32))
    planes, oriented = _fitted_planes(inverse_depth, valid, x, y)
    length = np.linalg.norm(planes, axis=-1, keepdims=True).astype(np.float32)
    oriented &= length[..., 0] > 0
    depth = np.where(valid, 1.0 / np.where(valid, inverse_depth, 1.0), 0.0).astype(np.float32)
    return SurfaceGrid(
        block=block,
        inverse_depth=inverse_depth,
        valid=valid,
        x=x,
        y=y,
        planes=planes,
        # With n . X = d on a plane, (a, b, c) = n / d, and d < 0 if n points to the camera.
        normals=np.asarray(-planes / np.where(length > 0, length, 1), dtype=np.float32),
        oriented=oriented,
        points=np.stack([x, y, np.ones_like(x)], axis=-1) * depth[..., None],
        cell_area=block * block / (camera.fx * camera.fy),
    )


def _reduced(
    depth_m: NDArray[np.float32], block: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the inverse depth [h, w] of blocks: the mean, or the nearest at depth steps."""
    height, width = depth_m.shape[0] // block, depth_m.shape[1] // block
    depth = depth_m[: height * block, : width * block]
    measured = depth > 0
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=measured)
    fraction = _block_mean(measured.astype(np.float32), block)
    valid = fraction >= _MIN_BLOCK
    mean = _block_mean(inverse, block) / np.maximum(fraction, 1e-6)
    # One axis after the other, which is faster.
    rows = inverse.reshape(height, block, width * block).max(axis=1)
    nearest = rows.reshape(height, width, block).max(axis=2)
    step = nearest - mean > 0.5 * _STEP * mean
    return np.where(valid, np.where(step, nearest, mean), 0).astype(np.float32), valid


def _block_mean(image: NDArray[np.float32], block: int) -> NDArray[np.float32]:
    size = image.shape[1] // block, image.shape[0] // block
    return image if block == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _fitted_planes(
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the planes [h, w, 3] of cells and the mask [h, w] of cells with a plane.

    A window across an edge mixes two surfaces. Each cell therefore selects the best fit of nine
    windows, in which it is at the centre, at a corner or at the middle of a side.
    """
    planes, residual = _window_fits(inverse_depth, valid, x, y)
    a, b, c = (np.ascontiguousarray(planes[..., k]) for k in range(3))
    cell = np.arange(valid.size).reshape(valid.shape)
    best = np.full(valid.shape, _NO_FIT, np.float32)
    chosen = cell.copy()
    for down in (0, -_RADIUS, _RADIUS):
        for across in (0, -_RADIUS, _RADIUS):
            error = moved(a, down, across, 0.0) * x
            error += moved(b, down, across, 0.0) * y
            error += moved(c, down, across, 0.0)
            error -= inverse_depth
            fit = moved(residual, down, across, _NO_FIT) + 0.5 * error * error
            better = fit < best
            np.copyto(best, fit, where=better)
            np.copyto(chosen, moved(cell, down, across, 0), where=better)
    return planes.reshape(-1, 3)[chosen], valid & (best < _NO_FIT)


def _window_fits(
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return least-squares planes [h, w, 3] of windows and mean squared residuals [h, w]."""
    weight = valid.astype(np.float32)
    side = 2 * _RADIUS + 1

    def total(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return cv2.boxFilter(
            values, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
        )

    count = total(weight)
    filled = np.maximum(count, 1).astype(np.float32)

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return total(weight * values) / filled

    q = inverse_depth
    mean_x, mean_y, mean_q = mean(x), mean(y), mean(q)
    xx, yy = mean(x * x) - mean_x * mean_x, mean(y * y) - mean_y * mean_y
    xy = mean(x * y) - mean_x * mean_y
    xq, yq = mean(x * q) - mean_x * mean_q, mean(y * q) - mean_y * mean_q
    qq = mean(q * q) - mean_q * mean_q
    # Windows with nearly collinear cells have no plane.
    determinant = xx * yy - xy * xy
    fits = (count >= _MIN_WINDOW * side * side) & (determinant > 1e-3 * xx * yy)
    determinant = np.where(fits, determinant, 1)
    a = (yy * xq - xy * yq) / determinant
    b = (xx * yq - xy * xq) / determinant
    c = mean_q - a * mean_x - b * mean_y
    planes = np.stack([a, b, c], axis=-1).astype(np.float32)
    residual = np.maximum(qq - a * xq - b * yq, 0)
    return planes, np.where(fits, residual, _NO_FIT)


def moved(image: NDArray, down: int, across: int, fill: Any) -> NDArray:
    """Translate an image by a number of cells; uncovered cells are set to `fill`."""
    out = np.full_like(image, fill)
    height, width = image.shape[:2]
    if abs(down) >= height or abs(across) >= width:
        return out
    target = np.s_[max(down, 0) : height + min(down, 0), max(across, 0) : width + min(across, 0)]
    source = np.s_[max(-down, 0) : height - max(down, 0), max(-across, 0) : width - max(across, 0)]
    out[target] = image[source]
    return out
