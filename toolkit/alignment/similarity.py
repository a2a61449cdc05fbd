"""Similarity of two aligned views: evidence for a relative pose that alignment did not minimise.

Alignment minimises residuals, so small residuals do not confirm its result: the minimum may be a
wrong one, and a view without texture has small residuals at every pose. Two other measurements can
be compared between poses, scenes and cameras. Normalised cross-correlation (NCC) of small blocks
does not depend on exposure or on the amount of texture, and falls once a pose moves texture by
more than its own size. Depth tells where the two views contradict each other: a surface that one
view measured lies in space that the other one measured as empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import FrameLevel, ModelLevel
from toolkit.geometry.free_space import free_space_margin_m
from toolkit.native.constants import NEAR_M

Array = NDArray[np.float64]

# Rows and columns of blocks, as in a view of 4:3.
_ROWS, _COLUMNS = 9, 12
BLOCKS = _ROWS * _COLUMNS
# Minimum number of pixels of a block, and minimum fraction of its pixels.
_MIN_PIXELS, _MIN_SHARE = 24, 0.4
# Minimum standard deviation of a block's intensity (0-1): the noise of a camera in a dark room.
_MIN_CONTRAST = 0.02
# The contrast at which a block has full weight. More contrast does not make it more reliable.
_FULL_CONTRAST = 0.1


@dataclass(frozen=True)
class Similarity:
    """How well a frame agrees with a view at a relative pose.

    Attributes:
        correlation: weighted median of the NCC (-1 to 1) of the textured blocks; NaN without any.
            The weight of a block grows with the weaker of its two contrasts.
        low_correlation: the weighted lower quartile of the same.
        blocks: number of textured blocks.
        covered: fraction of the frame's measured pixels that lie on measured pixels of the view.
        agreeing: fraction of these at the same depth, within the margin of free space.
        behind: fraction of these behind the view's surface, where the frame saw through it.
        in_front: fraction of these in front of the view's surface, where the view saw through them.
    """

    correlation: float
    low_correlation: float
    blocks: int
    covered: float
    agreeing: float
    behind: float
    in_front: float


def aligned_correlation(
    model: ModelLevel, frame: FrameLevel, T_model_frame: NDArray[np.float64]
) -> Similarity:
    """Compare a frame with a view at a relative pose.

    Each pixel of the frame with depth is projected into the view. Blocks are those of the frame,
    and hold the pixels at the same depth as the view: an occluded pixel is no evidence about the
    image. Intended for levels of about 160x120 pixels, where it takes a few milliseconds.

    Args:
        T_model_frame: [4, 4].
    """
    depth_m = frame.depth_m.cpu().numpy()
    rows, columns = np.nonzero(depth_m > 0)
    if len(rows) == 0:
        return Similarity(np.nan, np.nan, 0, 0.0, 0.0, 0.0, 0.0)
    points = frame.camera.rays()[rows, columns] * depth_m[rows, columns, None]
    points = points @ T_model_frame[:3, :3].T + T_model_frame[:3, 3]
    hit, view_m, intensity = sampled(model, points)
    gap_m = points[hit, 2] - view_m[hit]
    margin_m = free_space_margin_m(view_m[hit].astype(np.float32))
    agrees = np.zeros(len(rows), bool)
    agrees[hit] = np.abs(gap_m) <= margin_m
    own = frame.intensity.cpu().numpy()[rows, columns]
    blocks = block_numbers(rows, columns, depth_m.shape)
    size = depth_m.size / BLOCKS
    ncc, weight = _block_correlations(
        blocks[agrees], own[agrees], intensity[agrees], max(_MIN_PIXELS, _MIN_SHARE * size)
    )
    covered = int(hit.sum())
    return Similarity(
        correlation=weighted_quantile(ncc, weight, 0.5),
        low_correlation=weighted_quantile(ncc, weight, 0.25),
        blocks=len(ncc),
        covered=covered / len(rows),
        agreeing=int(agrees.sum()) / max(covered, 1),
        behind=int((gap_m > margin_m).sum()) / max(covered, 1),
        in_front=int((gap_m < -margin_m).sum()) / max(covered, 1),
    )


def sampled(model: ModelLevel, points: Array) -> tuple[NDArray[np.bool_], Array, Array]:
    """Depth and intensity of a view at points [n, 3] in its frame.

    Returns:
        Mask [n] of the points on measured pixels, and depths (m) and intensities [n] there.
    """
    texture = model.texture.cpu().numpy()
    height, width = texture.shape[:2]
    ahead = points[:, 2] > NEAR_M
    uv = model.camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
    inside = ahead & (uv >= 0).all(axis=1)
    inside &= (uv[:, 0] < width - 1) & (uv[:, 1] < height - 1)
    uv = np.where(inside[:, None], uv, 0.0)
    nearest = (uv + 0.5).astype(np.intp)
    depth_m = texture[nearest[:, 1], nearest[:, 0], 3].astype(np.float64)
    x, y = uv[:, 0].astype(np.intp), uv[:, 1].astype(np.intp)
    a, b = uv[:, 0] - x, uv[:, 1] - y
    weights = ((1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b)
    total, intensity = np.zeros(len(points)), np.zeros(len(points))
    for weight, dx, dy in zip(weights, (0, 1, 0, 1), (0, 0, 1, 1), strict=True):
        tap = texture[y + dy, x + dx]
        weight = weight * (tap[:, 3] > 0)
        total += weight
        intensity += weight * tap[:, 0]
    return inside & (depth_m > 0), depth_m, intensity / np.maximum(total, 1e-9)


def block_numbers(
    rows: NDArray[np.intp], columns: NDArray[np.intp], shape: tuple[int, ...]
) -> NDArray[np.intp]:
    """Number of the block [n] of each pixel of an image of a shape (H, W)."""
    return (rows * _ROWS // shape[0]) * _COLUMNS + columns * _COLUMNS // shape[1]


def _block_correlations(
    blocks: NDArray[np.intp], first: NDArray, second: NDArray, min_pixels: float
) -> tuple[Array, Array]:
    """NCC [b] and weight [b] of the textured blocks with at least a number of pixels."""
    count = np.bincount(blocks, minlength=BLOCKS)
    safe = np.maximum(count, 1)
    # Centred before squaring: sums of squares of nearly equal numbers lose the contrast.
    deviations = [
        image - (np.bincount(blocks, image, BLOCKS) / safe)[blocks] for image in (first, second)
    ]
    variances = [np.bincount(blocks, d**2, BLOCKS) / safe for d in deviations]
    covariance = np.bincount(blocks, deviations[0] * deviations[1], BLOCKS) / safe
    contrast = np.sqrt(np.minimum(*variances))
    # A texture that only one of the images shows is a contradiction and not missing evidence.
    strongest = np.sqrt(np.maximum(*variances))
    used = (count >= min_pixels) & (strongest >= _MIN_CONTRAST) & (contrast > 0)
    used &= contrast >= 0.25 * _MIN_CONTRAST
    ncc = covariance[used] / np.sqrt(variances[0] * variances[1])[used]
    return ncc, np.minimum(strongest[used], _FULL_CONTRAST)


def weighted_quantile(values: Array, weights: Array, quantile: float) -> float:
    """The value below which a fraction of the weight lies; NaN without values."""
    if len(values) == 0:
        return float("nan")
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    place = np.searchsorted(cumulative, quantile * cumulative[-1])
    return float(values[order[min(int(place), len(values) - 1)]])
