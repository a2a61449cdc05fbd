"""Similarity of two aligned views: evidence for a relative pose that alignment did not minimise.

Alignment minimises residuals, so small residuals do not confirm its result: the minimum may be a
wrong one, and a view without texture has small residuals at every pose. Two other measurements can
be compared between poses, scenes and cameras. Normalised cross-correlation (NCC) of small blocks
does not depend on exposure or on the amount of texture, and falls once a pose moves texture by
more than its own size. Depth shows where the two views contradict each other: a surface that one
view measured lies in space that the other one measured as empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.free_space import free_space_margin_m
from toolkit.base.native.constants import NEAR_M
from toolkit.splatting.alignment.data import FrameLevel, ModelLevel

Array = NDArray[np.float64]
Image = NDArray[np.float32]

# About the number of columns of pixels that are compared.
_SAMPLES = 80
# Rows and columns of blocks, as in a view of 4:3.
ROWS, COLUMNS = 9, 12
# Minimum number of pixels of a block, and minimum fraction of its pixels.
MIN_PIXELS, MIN_SHARE = 24, 0.4
# Minimum standard deviation of a block's intensity (0-1): the noise of a camera in a dark room.
MIN_CONTRAST = 0.02
# The contrast at which a block has full weight. More contrast does not make it more reliable.
FULL_CONTRAST = 0.1
# Minimum share of measured pixels among those that an interpolated pixel is a mean of.
_MIN_KNOWN = 0.99


@dataclass(frozen=True)
class Similarity:
    """How well a frame agrees with a view at a relative pose.

    Attributes:
        correlation: weighted median of the NCC (-1 to 1) of the textured blocks; NaN without any.
            The weight of a block grows with the weaker of its two contrasts.
        low_correlation: the weighted lower quartile of the same.
        blocks: number of textured blocks.
        covered: fraction of the frame's measured pixels that lie on measured pixels of the view.
        agreeing: fraction of these within the margin of free space from the planes of the view's
            surfaces; pixels at edges are left out.
    """

    correlation: float
    low_correlation: float
    blocks: int
    covered: float
    agreeing: float


def aligned_correlation(
    model: ModelLevel, frame: FrameLevel, T_model_frame: NDArray[np.float64]
) -> Similarity:
    """Compare a frame with a view at a relative pose.

    Each pixel of the frame with depth is projected into the view. Blocks are those of the frame,
    and hold the pixels at the same depth as the view: an occluded pixel is no evidence about the
    image. Takes half a millisecond.

    Args:
        T_model_frame: [4, 4].
    """
    # Every n-th pixel of a large image, at its full sharpness.
    step = max(1, frame.camera.width // _SAMPLES)
    own, depth_m = (
        np.ascontiguousarray(image.cpu().numpy()[::step, ::step])
        for image in (frame.intensity, frame.depth_m)
    )
    measured = depth_m > 0
    gap_m, view_m, intensity = sampled(model, frame.camera, depth_m, T_model_frame)
    covered = view_m > 0
    # Beside edges, where the view has no plane, a fraction of a pixel changes the depth.
    judged = covered & np.isfinite(gap_m)
    margin_m = free_space_margin_m(view_m)
    agrees = judged & (np.abs(gap_m) <= margin_m)
    ncc, weight = _block_correlations(agrees, own, intensity)
    count = max(int(judged.sum()), 1)
    return Similarity(
        correlation=weighted_quantile(ncc, weight, 0.5),
        low_correlation=weighted_quantile(ncc, weight, 0.25),
        blocks=len(ncc),
        covered=int(covered.sum()) / max(int(measured.sum()), 1),
        agreeing=int(agrees.sum()) / count,
    )


def sampled(
    model: ModelLevel, camera: Camera, depth_m: Image, T_model_frame: Array
) -> tuple[Image, Image, Image]:
    """What a view shows at the pixels of a frame.

    Args:
        depth_m: [H, W] of every n-th pixel of the camera.

    Returns:
        Distance [H, W] of the frame's points behind the planes of the view (m, NaN where it has
        none), and depth (m, 0 where missing) and intensity [H, W] of the view there.
    """
    texture, view = model.texture.cpu().numpy(), model.camera
    step = -(-camera.width // depth_m.shape[1])
    x = ((np.arange(0, camera.width, step) - camera.cx) / camera.fx).astype(np.float32)
    y = ((np.arange(0, camera.height, step) - camera.cy) / camera.fy).astype(np.float32)[:, None]
    R, t = (a.astype(np.float32) for a in (T_model_frame[:3, :3], T_model_frame[:3, 3]))
    right, down, forward = (
        depth_m * (R[axis, 0] * x + R[axis, 1] * y + R[axis, 2]) + t[axis] for axis in range(3)
    )
    ahead = (depth_m > 0) & (forward > NEAR_M)
    z = np.where(ahead, forward, np.float32(1.0))
    u = np.where(ahead, np.float32(view.fx) * right / z + np.float32(view.cx), np.float32(-2.0))
    v = np.float32(view.fy) * down / z + np.float32(view.cy)
    # Pixels at the border of the view or of a hole in it are mixed with zeros.
    known = cv2.remap((texture[..., 3] > 0).astype(np.float32), u, v, cv2.INTER_LINEAR)
    intensity = cv2.remap(np.ascontiguousarray(texture[..., 0]), u, v, cv2.INTER_LINEAR)
    view_m = cv2.remap(np.ascontiguousarray(texture[..., 3]), u, v, cv2.INTER_NEAREST)
    view_m[known < _MIN_KNOWN] = 0.0
    # The distance from a plane does not change along it, as depth does on slanted surfaces.
    plane = cv2.remap(model.surface.cpu().numpy(), u, v, cv2.INTER_NEAREST)
    along = plane[..., 0] * right + plane[..., 1] * down + plane[..., 2] * forward
    sign = np.sign(plane[..., 3])
    gap_m = np.where(sign != 0, sign * (along - plane[..., 3]), np.float32(np.nan))
    return gap_m, view_m, intensity


def _block_correlations(
    used: NDArray[np.bool_], first: Image, second: Image
) -> tuple[Array, Array]:
    """NCC [b] and weight [b] of the textured blocks of two images [H, W] within a mask."""
    count = _block_sums(used.astype(np.float32))
    safe = np.maximum(count, 1)
    # Centred before squaring: sums of squares of nearly equal numbers lose the contrast.
    a, b = (
        np.where(used, image - _spread(_block_sums(np.where(used, image, 0)) / safe, used.shape), 0)
        for image in (first, second)
    )
    variances = np.stack([_block_sums(a * a) / safe, _block_sums(b * b) / safe])
    covariance = _block_sums(a * b) / safe
    weakest, strongest = np.sqrt(variances.min(axis=0)), np.sqrt(variances.max(axis=0))
    # A texture that only one of the images shows is a contradiction and not missing evidence.
    size = used.size / (ROWS * COLUMNS)
    textured = (count >= max(MIN_PIXELS, MIN_SHARE * size)) & (strongest >= MIN_CONTRAST)
    textured &= weakest >= 0.25 * MIN_CONTRAST
    ncc = covariance[textured] / np.sqrt(variances.prod(axis=0)[textured])
    return ncc, np.minimum(strongest[textured], FULL_CONTRAST)


def _block_sums(image: NDArray) -> Array:
    """Sums [9, 12] of an image [H, W] over its blocks."""
    rows, columns = _starts(image.shape[0], ROWS), _starts(image.shape[1], COLUMNS)
    by_rows = np.add.reduceat(image, rows, axis=0)
    return np.add.reduceat(by_rows, columns, axis=1, dtype=np.float64)


def _spread(blocks: Array, shape: tuple[int, ...]) -> Image:
    """An image [H, W] with the value of each block [9, 12] at its pixels."""
    heights, widths = (
        np.diff([*_starts(size, number), size])
        for size, number in zip(shape, (ROWS, COLUMNS), strict=True)
    )
    return np.repeat(np.repeat(blocks.astype(np.float32), heights, axis=0), widths, axis=1)


def _starts(size: int, number: int) -> NDArray[np.intp]:
    """First row or column of each block."""
    return np.arange(number) * size // number


def weighted_quantile(values: Array, weights: Array, quantile: float) -> float:
    """The value below which a fraction of the weight lies; NaN without values."""
    if len(values) == 0:
        return float("nan")
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    place = np.searchsorted(cumulative, quantile * cumulative[-1])
    return float(values[order[min(int(place), len(values) - 1)]])
