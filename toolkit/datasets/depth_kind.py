"""Whether depth images hold z-depth, or distances along the rays, or inverse depth.

All three look plausible. But the inverse of z-depth is an affine function of the pixel on every
plane, so that walls, floors and tables of other images are curved. What noise-free images show
clearly, the noise of sensors hides; nothing is reported for them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from toolkit.frame import Frame

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
    depth = frame.depth_m[step // 2 :: step, step // 2 :: step].astype(np.float64)
    rays = frame.camera.rays(step)
    rows = np.array_split(np.arange(depth.shape[0]), _ROWS)
    columns = np.array_split(np.arange(depth.shape[1]), _COLUMNS)
    cells = [np.ix_(r, c) for r in rows for c in columns]
    found = [_cell_residuals(depth[cell].ravel(), rays[cell].reshape(-1, 3)) for cell in cells]
    return np.array([residual for residual in found if residual is not None]).reshape(-1, 3)


def _cell_residuals(depth: Array, rays: Array) -> Array | None:
    """Relative residuals [3] of the best plane through a cell; None if too little is measured."""
    measured = depth > 0
    if measured.sum() < max(_MIN_SAMPLES, _MIN_MEASURED * measured.size):
        return None
    depth, rays = depth[measured], rays[measured]
    inverse = np.stack([1.0 / depth, np.linalg.norm(rays, axis=1) / depth, depth], axis=1)
    plane = np.linalg.lstsq(rays, inverse, rcond=None)[0]
    return np.sqrt(((inverse - rays @ plane) ** 2).mean(axis=0)) / inverse.mean(axis=0)
