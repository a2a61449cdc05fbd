"""Plane sweeps in NumPy: the reference of the C++ kernels, for machines without a compiler."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.problem import (
    Consensus,
    Image,
    NeighbourView,
    Planes,
    SweepOptions,
    SweptPlanes,
)

Array = NDArray[np.float64]

# See matching.cpp and aggregation.cpp.
_WINDOW = (7, 7)
_NOISE_VARIANCE = 1.6e-5
_MAX_COST, _UNKNOWN_COST = 255, 128
_EDGE_CONTRAST = 0.04
# See upsampling.cpp and consensus.cpp.
_PIXEL_CONTRAST = 0.02
_MIN_DEPTH = 1e-6
# See fattening.cpp.
_REACH, _EDGE, _CONTRAST, _PREFERENCE, _MIN_FAR = 11, 1.05, 0.1, 1.5, 3


def plane_sweep(
    camera: Camera,
    intensity: Image,
    sources: Sequence[NeighbourView],
    planes: Planes,
    options: SweepOptions,
) -> SweptPlanes:
    """See `toolkit.depth.depth_priors.plane_sweep.plane_sweep`."""
    costs = np.stack(
        [
            _costs(camera, intensity, sources, planes.first + np.float32(d * planes.step))
            for d in range(planes.count)
        ],
        axis=-1,
    )
    totals = _aggregated(costs, intensity, options)
    best = totals.argmin(-1)
    number = np.arange(planes.count)
    beside = np.abs(number - best[..., None]) <= 1
    least = _at(totals, best)
    other = np.where(beside, np.iinfo(np.uint16).max, totals).min(-1)
    cost = _at(costs, best)
    before = _at(totals, np.maximum(best - 1, 0))
    after = _at(totals, np.minimum(best + 1, planes.count - 1))
    curvature = before - 2 * least + after
    inner = (best > 0) & (best < planes.count - 1) & (curvature > 0)
    place = best + np.where(inner, 0.5 * (before - after) / np.where(inner, curvature, 1), 0.0)
    return SweptPlanes(
        np.where(cost == _UNKNOWN_COST, -1.0, place).astype(np.float32),
        (1.0 - cost / _MAX_COST).astype(np.float32),
        np.minimum((other - least) / (4.0 * _MAX_COST), 1.0).astype(np.float32),
    )


def _at(volume: NDArray[np.int32], plane: NDArray[np.int64]) -> NDArray[np.int32]:
    return np.take_along_axis(volume, plane[..., None], -1)[..., 0]


def _costs(
    camera: Camera, intensity: Image, sources: Sequence[NeighbourView], inverse_depth: Image
) -> NDArray[np.int32]:
    """Costs [H, W] at an inverse depth [H, W]: 1 - ZNCC, averaged over the two best sources."""
    found = []
    for source in sources:
        warped, inside = _warped(camera, source, inverse_depth)
        found.append(np.where(inside, _correlation(intensity, warped), -np.inf))
    best, second, *_ = [*np.sort(np.stack(found), 0)[::-1], np.full(intensity.shape, -np.inf)]
    zncc = np.where(np.isfinite(second), 0.5 * (best + second), best)
    cost = _MAX_COST * np.clip(1.0 - zncc, 0.0, 1.0)
    return np.floor(np.where(np.isfinite(best), cost, _UNKNOWN_COST) + 0.5).astype(np.int32)


def _warped(
    camera: Camera, source: NeighbourView, inverse_depth: Image
) -> tuple[Array, NDArray[np.bool_]]:
    """The source's image [H, W] at an inverse depth, and where it shows the pixel."""
    T = source.T_other_reference
    points = camera.rays() @ T[:3, :3].T + inverse_depth[..., None] * T[:3, 3]
    in_front = points[..., 2] > 1e-6
    u, v = np.moveaxis(camera.project(np.where(in_front[..., None], points, [0, 0, 1])), -1, 0)
    right, bottom = camera.width - 1, camera.height - 1
    x, y = u.clip(0, right), v.clip(0, bottom)
    inside = in_front & (np.abs(u - x) < 0.5) & (np.abs(v - y) < 0.5)
    return _bilinear(source.image, x, y), inside


def _bilinear(image: Image, u: Array, v: Array) -> Array:
    height, width = image.shape
    x, y = u.astype(np.int64), v.astype(np.int64)
    a, b = u - x, v - y
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    upper = image[y, x] + a * (image[y, right] - image[y, x])
    lower = image[below, x] + a * (image[below, right] - image[below, x])
    return upper + b * (lower - upper)


def _correlation(image: Image, other: Array) -> Array:
    a = image.astype(np.float64)
    mean_a, mean_b = _mean(a), _mean(other)
    variance_a = np.maximum(_mean(a * a) - mean_a**2, 0.0) + _NOISE_VARIANCE
    variance_b = np.maximum(_mean(other * other) - mean_b**2, 0.0) + _NOISE_VARIANCE
    return (_mean(a * other) - mean_a * mean_b) / np.sqrt(variance_a * variance_b)


def _mean(image: Array) -> Array:
    """Mean [H, W] of the window around each pixel; the border of the image is repeated."""
    return cv2.blur(image, _WINDOW, borderType=cv2.BORDER_REPLICATE)


def _aggregated(
    costs: NDArray[np.int32], intensity: Image, options: SweepOptions
) -> NDArray[np.int32]:
    """Sums [H, W, D] of the path costs of four directions."""
    step = round(_MAX_COST * options.step_penalty)
    jump = _MAX_COST * options.jump_penalty
    totals = np.zeros_like(costs)
    for axis in (0, 1):
        lines, values = np.moveaxis(costs, axis, 0), np.moveaxis(intensity, axis, 0)
        sums = np.moveaxis(totals, axis, 0)
        for order in (range(len(lines)), range(len(lines) - 1, -1, -1)):
            path, last = np.zeros_like(lines[0]), order[0]
            for i in order:
                penalty = jump / (1.0 + np.abs(values[i] - values[last]) / _EDGE_CONTRAST)
                p2 = np.maximum(np.floor(penalty + 0.5).astype(np.int32), step)
                path = _continued(path, lines[i], step, p2)
                sums[i] += path
                last = i
    return totals


def _continued(
    path: NDArray[np.int32], costs: NDArray[np.int32], p1: int, p2: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Path costs [N, D] at the next pixels."""
    least = path.min(-1, keepdims=True)
    best = np.minimum(path, least + p2[:, None])
    best[:, 1:] = np.minimum(best[:, 1:], path[:, :-1] + p1)
    best[:, :-1] = np.minimum(best[:, :-1], path[:, 1:] + p1)
    return costs + best - least


def double_depth(half: Image, half_intensity: Image, intensity: Image, max_step: float) -> Image:
    """See `toolkit.depth.depth_priors.plane_sweep.double_depth`."""
    (h, w), (height, width) = half.shape, intensity.shape
    y, b = _between(height, h)
    x, a = _between(width, w)
    depths, differences, weights = [], [], []
    for k in range(4):
        place = np.ix_(np.minimum(y + k // 2, h - 1), np.minimum(x + k % 2, w - 1))
        across, down = a if k % 2 else 1 - a, b if k // 2 else 1 - b
        weight = down[:, None] * across
        difference = np.abs(half_intensity[place] - intensity) + _PIXEL_CONTRAST * (1 - weight)
        depths.append(half[place])
        differences.append(np.where(half[place] > 0, difference, np.inf))
        weights.append(weight)
    q = np.stack(depths)
    similar = np.take_along_axis(q, np.argmin(differences, 0)[None], 0)[0]
    one_surface = (q > 0).all(0) & (q.max(0) - q.min(0) < max_step)
    return np.where(one_surface, (q * weights).sum(0), similar).astype(np.float32)


def _between(count: int, half: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """First of the two pixels of the half image around each pixel, and the share of the second."""
    place = 0.5 * np.arange(count, dtype=np.float32) - 0.25
    first = np.clip(np.floor(place).astype(np.int64), 0, max(half - 2, 0))
    return first, np.clip(place - first, 0.0, 1.0).astype(np.float32)


def remove_fattening(intensity: Image, inverse_depth: Image, behind: Image) -> Image:
    """See `toolkit.depth.depth_priors.coarse_to_fine.remove_fattening`."""
    known = inverse_depth > 0
    border = known & (inverse_depth > np.float32(_EDGE) * behind)
    rows, columns = np.nonzero(border)
    own, level = inverse_depth[rows, columns], intensity[rows, columns]
    middle = np.float32(0.5) * (own + behind[rows, columns])
    nearest = own + (own - middle)
    padding = ((_REACH, _REACH), (_REACH, _REACH))
    levels = np.pad(intensity, padding)
    depths = np.pad(np.where(known, inverse_depth, np.inf), padding, constant_values=np.inf)
    inner = np.pad(np.where(known & ~border, inverse_depth, 0.0), padding)
    far, near, like_far, like_near = np.zeros((4, len(rows)))
    for dy, dx in _chessboard(_REACH):
        place = (rows + _REACH + dy, columns + _REACH + dx)
        is_far = depths[place] < middle
        is_near = (inner[place] >= middle) & (inner[place] < nearest)
        difference = (levels[place] - level) / _CONTRAST
        similarity = np.maximum(1.0 - difference**2, 0.0) ** 2
        far += is_far
        near += is_near
        like_far += is_far * similarity
        like_near += is_near * similarity
    more = (near == 0) | (like_far * near >= _PREFERENCE * like_near * far)
    removed = (far >= _MIN_FAR) & more
    kept = inverse_depth.copy()
    kept[rows[removed], columns[removed]] = 0.0
    return kept


def _chessboard(radius: int) -> list[tuple[int, int]]:
    """Every second pixel (dy, dx) of a disc."""
    around = range(-radius, radius + 1)
    return [
        (y, x) for y in around for x in around if (x + y) % 2 == 0 and x * x + y * y <= radius**2
    ]


def find_consensus(
    camera: Camera,
    inverse_depth: Image,
    others: Sequence[NeighbourView],
    limits: tuple[float, float],
) -> Consensus:
    """See `toolkit.depth.depth_priors.consensus.find_consensus`."""
    known = inverse_depth > 0
    q = np.where(known, inverse_depth, 1.0).astype(np.float64)
    deviation, squares, parallax, agreeing, conflicting = np.zeros((5, *q.shape))
    for other in others:
        moved, implied, agrees, conflicts = _compared(camera, q, known, other, limits)
        parallax = np.maximum(parallax, moved)
        deviation += implied
        squares += implied**2
        agreeing += agrees
        conflicting += conflicts
    mean = deviation / (1 + agreeing)
    spread = np.sqrt(np.maximum(squares / (1 + agreeing) - mean**2, 0.0)) / (1 + mean)
    images = (np.where(known, q * (1 + mean), 0.0), spread, parallax, agreeing, conflicting)
    return Consensus(*(image.astype(np.float32) for image in images))


def _compared(
    camera: Camera,
    q: Array,
    known: NDArray[np.bool_],
    other: NeighbourView,
    limits: tuple[float, float],
) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Parallax, relative deviation of the other's inverse depth, and where it agrees, conflicts."""
    tolerance, in_front = limits
    R, t = other.T_other_reference[:3, :3], other.T_other_reference[:3, 3]
    direction = camera.rays() @ R.T
    points = direction / q[..., None] + t
    seen = known & (points[..., 2] > _MIN_DEPTH)
    x, y, z = np.moveaxis(np.where(seen[..., None], points, [0.0, 0.0, 1.0]), -1, 0)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    px, py = u.clip(0, camera.width - 1), v.clip(0, camera.height - 1)
    seen &= (np.abs(u - px) < 0.5) & (np.abs(v - py) < 0.5)
    moved = np.hypot(camera.fx * (t[0] - x / z * t[2]), camera.fy * (t[1] - y / z * t[2])) / z
    there = _surface_at(other.image, px, py, tolerance)
    measured = seen & (there > 0)
    depth = 1.0 / np.where(measured, there, 1.0)
    along = (depth - t[2]) / np.where(direction[..., 2] == 0, np.inf, direction[..., 2])
    deviation = 1.0 / (np.where(along == 0, np.inf, along) * q) - 1.0
    agrees = measured & (np.abs(depth - z) < tolerance * z) & (np.abs(deviation) < 2 * tolerance)
    conflicts = measured & (depth > (1 + in_front) * z)
    return np.where(seen, moved, 0.0), np.where(agrees, deviation, 0.0), agrees, conflicts


def _surface_at(image: Image, u: Array, v: Array, tolerance: float) -> Array:
    """Inverse depth at positions: interpolated on a surface, else that of the nearest pixel."""
    height, width = image.shape
    x = np.minimum(u.astype(np.int64), width - 2)
    y = np.minimum(v.astype(np.int64), height - 2)
    around = np.stack([image[y + k // 2, x + k % 2] for k in range(4)])
    least, most = around.min(0), around.max(0)
    nearest = image[y + (v - y >= 0.5), x + (u - x >= 0.5)]
    one_surface = (least > 0) & (most - least < 2 * tolerance * most)
    return np.where(one_surface, _bilinear(image, u, v), nearest)
