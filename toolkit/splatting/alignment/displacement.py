"""Displacement of two aligned views that no relative pose explains.

An image of a rolling shutter in a turn is bent. Alignment finds the pose that fits it best, which
is wrong by some degrees between turns in different directions, with residuals like those of another
texture. What is left shows it: image blocks are displaced against each other. Each block's
displacement is found by iterations of Lucas and Kanade (1981) at its own exposure.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.free_space import free_space_margin_m
from toolkit.base.native.constants import NEAR_M
from toolkit.splatting.alignment.data import FrameLevel, ModelLevel
from toolkit.splatting.alignment.similarity import (
    COLUMNS,
    FULL_CONTRAST,
    MIN_CONTRAST,
    MIN_PIXELS,
    MIN_SHARE,
    ROWS,
    weighted_quantile,
)

Array = NDArray[np.float64]

_BLOCKS = ROWS * COLUMNS
_ITERATIONS = 4
# Maximum displacement of a block, and maximum step, in pixels.
_MAX_PX, _MAX_STEP_PX = 6.0, 1.5
# Relative increase of the diagonal of a block's normal equations: edges fix one direction only.
_DAMPING = 0.05
# Minimum correlation of a block that was found, and minimum number of such blocks.
_MIN_CORRELATION, _MIN_BLOCKS = 0.6, 5


def displacement_rad(
    model: ModelLevel, frame: FrameLevel, T_model_frame: NDArray[np.float64]
) -> float:
    """Weighted median displacement of a frame's blocks in a view, as an angle in radians.

    Views of global shutters have 0.0003 to 0.001 at their true pose; views of real sensors,
    with errors of calibration and depth, 0.002 to 0.007. Intended for levels of about 160x120
    pixels.

    Args:
        T_model_frame: [4, 4].

    Returns:
        NaN if fewer than five blocks with texture were found again.
    """
    blocks, own, uv = _agreeing_pixels(model, frame, T_model_frame)
    texture = model.texture.cpu().numpy().astype(np.float64)
    shift, found = np.zeros((_BLOCKS, 2)), np.zeros(_BLOCKS)
    contrast, count = np.zeros(_BLOCKS), np.zeros(_BLOCKS, np.intp)
    for _ in range(_ITERATIONS):
        hit, texels = _interpolated(texture, uv + shift[blocks])
        step, found, contrast, count = _step(blocks[hit], own[hit], texels[hit])
        shift = np.clip(shift + step, -_MAX_PX, _MAX_PX)
    size = frame.depth_m.numel() / _BLOCKS
    usable = (count >= max(MIN_PIXELS, MIN_SHARE * size)) & (contrast >= MIN_CONTRAST)
    usable &= found >= _MIN_CORRELATION
    if usable.sum() < _MIN_BLOCKS:
        return float("nan")
    angles = np.linalg.norm(shift[usable], axis=1) / model.camera.focal
    return weighted_quantile(angles, np.minimum(contrast[usable], FULL_CONTRAST), 0.5)


def _agreeing_pixels(
    model: ModelLevel, frame: FrameLevel, T_model_frame: NDArray[np.float64]
) -> tuple[NDArray[np.intp], Array, Array]:
    """Block [n], intensity [n] and position in the view [n, 2] of the pixels at its depth."""
    depth_m = frame.depth_m.cpu().numpy()
    rows, columns = np.nonzero(depth_m > 0)
    points = frame.camera.rays()[rows, columns] * depth_m[rows, columns, None]
    points = points @ T_model_frame[:3, :3].T + T_model_frame[:3, 3]
    agrees, view_m = _depths_at(model, points)
    margin_m = free_space_margin_m(view_m.astype(np.float32))
    agrees &= np.abs(points[:, 2] - view_m) <= margin_m
    own = frame.intensity.cpu().numpy()[rows, columns][agrees].astype(np.float64)
    blocks = _block_numbers(rows, columns, depth_m.shape)[agrees]
    return blocks, own, model.camera.project(points[agrees])


def _depths_at(model: ModelLevel, points: Array) -> tuple[NDArray[np.bool_], Array]:
    """Mask [n] of the points [n, 3] on measured pixels of a view, and its depths [n] there (m)."""
    depth_m = model.texture.cpu().numpy()[..., 3]
    height, width = depth_m.shape
    ahead = points[:, 2] > NEAR_M
    uv = model.camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
    inside = ahead & (uv >= 0).all(axis=1)
    inside &= (uv[:, 0] < width - 1) & (uv[:, 1] < height - 1)
    column, row = (np.where(inside[:, None], uv, 0.0) + 0.5).astype(np.intp).T
    view_m = depth_m[row, column].astype(np.float64)
    return inside & (view_m > 0), view_m


def _block_numbers(
    rows: NDArray[np.intp], columns: NDArray[np.intp], shape: tuple[int, ...]
) -> NDArray[np.intp]:
    """Number of the block [n] of each pixel of an image of a shape (H, W)."""
    return (rows * ROWS // shape[0]) * COLUMNS + columns * COLUMNS // shape[1]


def _interpolated(texture: Array, uv: Array) -> tuple[NDArray[np.bool_], Array]:
    """Mask [n] of positions among measured pixels; intensity and its derivatives there [n, 3]."""
    height, width = texture.shape[:2]
    hit = (uv >= 0).all(axis=1) & (uv[:, 0] < width - 1) & (uv[:, 1] < height - 1)
    uv = np.where(hit[:, None], uv, 0.0)
    x, y = uv.astype(np.intp).T
    a, b = (uv - np.column_stack([x, y])).T[..., None]
    taps = [texture[y, x], texture[y, x + 1], texture[y + 1, x], texture[y + 1, x + 1]]
    weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    for tap in taps:
        hit &= tap[:, 3] > 0
    return hit, sum(w * tap[:, :3] for w, tap in zip(weights, taps, strict=True))


def _step(
    blocks: NDArray[np.intp], own: Array, texels: Array
) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """One iteration: steps [B, 2], and correlation, contrast and number of pixels [B] before it."""
    count = np.bincount(blocks, minlength=_BLOCKS)
    safe = np.maximum(count, 1)

    def summed(values: Array) -> Array:
        return np.asarray(np.bincount(blocks, values, _BLOCKS), dtype=np.float64)

    own = own - (summed(own) / safe)[blocks]
    view = texels[:, 0] - (summed(texels[:, 0]) / safe)[blocks]
    sigmas = [np.maximum(np.sqrt(summed(image**2) / safe), 1e-9) for image in (own, view)]
    # At the view's exposure.
    residual = own * (sigmas[1] / sigmas[0])[blocks] - view
    gx, gy = texels[:, 1], texels[:, 2]
    xx, xy, yy = summed(gx * gx), summed(gx * gy), summed(gy * gy)
    bx, by = summed(gx * residual), summed(gy * residual)
    damping = _DAMPING * (xx + yy) + 1e-9
    xx, yy = xx + damping, yy + damping
    step = np.column_stack([yy * bx - xy * by, xx * by - xy * bx]) / (xx * yy - xy**2)[:, None]
    correlation = summed(own * view) / safe / (sigmas[0] * sigmas[1])
    step = np.clip(step, -_MAX_STEP_PX, _MAX_STEP_PX)
    return step, correlation, np.minimum(*sigmas), count
