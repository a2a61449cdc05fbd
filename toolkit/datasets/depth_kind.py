"""Whether depth images hold z-depth, or distances along the rays, or inverse depth.

All three look plausible. But the inverse of z-depth is an affine function of the pixel on every
plane, so that walls, floors and tables of other images are curved. What noise-free images show
clearly, the noise of sensors hides; nothing is reported for them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame

Array = NDArray[np.float64]

# Depth is sampled at about this width, and planes are fitted in cells of a grid.
_WIDTH, _COLUMNS, _ROWS = 160, 8, 6
# Minimum numbers of samples in a cell and of flat cells, and share of a cell that has depth.
_MIN_SAMPLES, _MIN_FLAT, _MIN_MEASURED = 64, 20, 0.9
# A cell is flat if the residual of a plane is smaller, relative to the depth. Residuals below the
# second value are those of rounding.
_FLAT, _ROUNDING = 1e-3, 1e-4
# Another kind of depth is reported if its residuals are so many times as small, in the median of
# the cells. On office0, the HoloLens walk and four rooms, those of z-depth are never larger. Where
# depth is of another kind, its residuals are smaller by 4.5 to 10 (distances) and 1.6 to 18
# (inverse), except for the HoloLens and a room with a sensor's noise, which do not decide.
_CLEARLY = 1.5

_WORDS = (
    "distances along the rays of the pixels; divide them by sqrt(1 + ((u - cx) / fx)^2 + "
    "((v - cy) / fy)^2)",
    "inverse depth (disparity); invert the values",
)


def depth_kind_fault(frames: Iterable[Frame]) -> str | None:
    """A line about depth images that clearly do not hold z-depth, None without one."""
    found = [_residuals(frame) for frame in frames]
    residuals = np.concatenate([*found, np.zeros((0, 3))])
    flat = residuals[residuals.min(axis=1, initial=np.inf) < _FLAT] + _ROUNDING
    if len(flat) < _MIN_FLAT:
        return None
    gains = np.median(flat[:, :1] / flat[:, 1:], axis=0)
    best = int(gains.argmax())
    if gains[best] < _CLEARLY:
        return None
    return f"flat surfaces are curved, because depth is not z-depth but holds {_WORDS[best]}"


def _residuals(frame: Frame) -> Array:
    """Relative residuals [K, 3] of planes in the cells of a frame, for each kind of depth."""
    step = max(1, frame.camera.width // _WIDTH)
    depth = _in_cells(frame.depth_m[step // 2 :: step, step // 2 :: step, None])
    measured = depth > 0
    counts = measured.sum(axis=(1, 2))
    used = counts >= max(_MIN_SAMPLES, _MIN_MEASURED * depth.shape[1])
    depth, measured, counts = depth[used], measured[used], counts[used, None]
    rays = measured * _in_cells(frame.camera.rays(step))[used]
    z = np.where(measured, depth, 1.0)
    inverse = np.concatenate(
        [measured / z, np.linalg.norm(rays, axis=2, keepdims=True) / z, depth], axis=2
    )
    transposed = np.swapaxes(rays, 1, 2)
    planes = np.linalg.solve(transposed @ rays, transposed @ inverse)
    squares = ((inverse - rays @ planes) ** 2).sum(axis=1) / counts
    return np.sqrt(squares) / (inverse.sum(axis=1) / counts)


def _in_cells(image: NDArray) -> Array:
    """Pixels [K, N, C] of an image [H, W, C] by the cells of the grid, without a rest."""
    height, width = image.shape[0] // _ROWS, image.shape[1] // _COLUMNS
    whole = image[: _ROWS * height, : _COLUMNS * width].astype(np.float64)
    cells = whole.reshape(_ROWS, height, _COLUMNS, width, -1).swapaxes(1, 2)
    return cells.reshape(_ROWS * _COLUMNS, height * width, -1)
