"""Completion of depth on planar surfaces without texture.

Matching finds no depth where an image shows no texture: on painted walls, doors and boards. Such a
hole is completed if the depth around it and at the edges that bound it lies on one plane, apart
from what is in front of the plane. Holes end where the intensity changes, so that no surface
continues behind another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.depth.depth_priors.problem import Image

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Largest change of intensity per pixel on a surface without texture.
_MAX_GRADIENT = 0.012
_MIN_HOLE, _MIN_SUPPORT = 60, 60
# Distance up to which depth around a hole belongs to its surface, in pixels.
_RING = 10
# Distance in pixels up to which depth at the edges that bound a hole is that of its surface, unless
# something in front of the surface bounds it.
_EDGE_PX = 6
# Relative residuals of points on a plane, and the share of points that must be on it.
_TOLERANCE, _MIN_SHARE = 0.02, 0.75
# Share of all points that must be on it, since nearer objects may bound a hole; and weight of those
# beyond it in the choice of the plane.
_MIN_OF_ALL, _SEEN_THROUGH = 0.5, 2
_TRIALS, _TRIAL_POINTS = 40, 200
# A pixel is completed if its depth follows from the plane: its leverage is 1 in the centre of the
# points, and above 8 at twice their extent.
_MAX_LEVERAGE, _MAX_SIGMA = 8.0, 0.03
# Measured depth has common errors within a window; errors of planes are at least as large as that.
_WINDOW = 50.0
_MIN_DEVIATION = 0.003


@dataclass(frozen=True)
class FilledHoles:
    """Depth of the holes of an image.

    Attributes:
        inverse_depth: [H, W] float32, 0 outside the holes and where they remain.
        relative_sigma: [H, W] float32 relative standard deviation, inf there.
    """

    inverse_depth: Image
    relative_sigma: Image


@dataclass(frozen=True)
class _Plane:
    """Inverse depth as a linear function of pixels (x, y), relative to a centre and a scale.

    Attributes:
        coefficients: [3].
        moments: [3, 3] mean of the outer products of the points that it was fitted to.
        variance: of their residuals; that of the plane at its centre is `variance / samples`.
        samples: number of independent points.
    """

    coefficients: Array
    moments: Array
    variance: float
    samples: float


def complete(intensity: Image, inverse_depth: Image, rng: np.random.Generator) -> FilledHoles:
    """Complete the holes of surfaces without texture by planes.

    Args:
        intensity: [H, W] in [0, 1].
        inverse_depth: [H, W], 0 where unknown.
        rng: chooses the points that planes are tried with.
    """
    smooth = is_smooth(intensity)
    known = inverse_depth > 0
    holes = (smooth & ~known).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(holes, connectivity=4)
    found = np.zeros_like(inverse_depth)
    sigma = np.full_like(inverse_depth, np.inf)
    for hole in range(1, count):
        if boxes[hole, cv2.CC_STAT_AREA] >= _MIN_HOLE:
            part = _part(boxes[hole])
            out = FilledHoles(found[part], sigma[part])
            _complete_hole(labels[part] == hole, smooth[part], inverse_depth[part], out, rng)
    return FilledHoles(found, sigma)


def is_smooth(intensity: Image) -> Mask:
    """Where an image [H, W] in [0, 1] changes slowly, as on surfaces without texture."""
    blurred = cv2.GaussianBlur(intensity, (5, 5), 1.0)
    x = cv2.Sobel(blurred, cv2.CV_32F, 1, 0, scale=1.0 / 8.0)
    y = cv2.Sobel(blurred, cv2.CV_32F, 0, 1, scale=1.0 / 8.0)
    return np.hypot(x, y) < _MAX_GRADIENT


def _part(box: NDArray[np.int32]) -> tuple[slice, slice]:
    """Rows and columns of a hole and its surroundings."""
    x, y, width, height = (int(n) for n in box[:4])
    return (
        slice(max(0, y - _RING), y + height + _RING),
        slice(max(0, x - _RING), x + width + _RING),
    )


def _complete_hole(
    hole: Mask, smooth: Mask, inverse_depth: Image, out: FilledHoles, rng: np.random.Generator
) -> None:
    """Complete one hole in parts of the images; `out` is changed."""
    support = (_around(hole, smooth) | _border(hole)) & (inverse_depth > 0)
    if support.sum() < _MIN_SUPPORT:
        return
    plane = _fitted(_places(support), inverse_depth[support].astype(np.float64), rng)
    if plane is None:
        return
    places = _places(hole)
    values = places @ plane.coefficients
    leverage = (places @ np.linalg.inv(plane.moments) * places).sum(-1)
    deviation = np.sqrt(plane.variance * (1.0 + leverage / plane.samples))
    kept = (values > 0) & (deviation < _MAX_SIGMA * values) & (leverage < _MAX_LEVERAGE)
    rows, columns = (index[kept] for index in np.nonzero(hole))
    out.inverse_depth[rows, columns] = values[kept]
    out.relative_sigma[rows, columns] = deviation[kept] / values[kept]


def _around(hole: Mask, smooth: Mask) -> Mask:
    """Pixels that are connected with a hole by pixels of slowly changing intensity."""
    allowed, reached = smooth.astype(np.uint8), hole.astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    for _ in range(_RING):
        reached = cv2.dilate(reached, kernel) & allowed
    return reached.astype(bool)


def _border(hole: Mask) -> Mask:
    """Pixels beside a hole, across the edges of the image that bound it."""
    side = 2 * _EDGE_PX + 1
    return cv2.dilate(hole.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool)


def _places(mask: Mask) -> Array:
    """Homogeneous coordinates [N, 3] of pixels, about 1 at the border of the image."""
    rows, columns = np.nonzero(mask)
    scale = 0.5 * max(mask.shape)
    x = (columns - 0.5 * mask.shape[1]) / scale
    y = (rows - 0.5 * mask.shape[0]) / scale
    return np.stack([x, y, np.ones(len(x))], axis=1)


def _fitted(places: Array, values: Array, rng: np.random.Generator) -> _Plane | None:
    """The plane of most of the points; None if there is none."""
    near = _ransac(places, values, rng)
    if near is None:
        return None
    for _ in range(2):
        points = places[near]
        moments = points.T @ points / len(points)
        if np.linalg.cond(moments) > 1e8:  # all points on a line
            return None
        coefficients = np.linalg.inv(moments) @ (points.T @ values[near] / len(points))
        near = _on_surface(places @ coefficients, values)
        if near is None:
            return None
    points = places[near]
    residual = values[near] - points @ coefficients
    variance = residual.var() + (_MIN_DEVIATION * values.mean()) ** 2
    return _Plane(coefficients, moments, float(variance), len(points) / _WINDOW)


def _ransac(places: Array, values: Array, rng: np.random.Generator) -> Mask | None:
    """Points on the plane through three points that has most of them."""
    some = rng.choice(len(values), min(len(values), _TRIAL_POINTS), replace=False)
    threes = some[rng.integers(0, len(some), (_TRIALS, 3))]
    threes = threes[np.abs(np.linalg.det(places[threes])) > 1e-6]
    if not len(threes):
        return None
    planes = np.linalg.solve(places[threes], values[threes][..., None])[..., 0]
    fitted = planes @ places[some].T
    on = _on_plane(fitted, values[some]).sum(-1)
    seen_through = _beyond(fitted, values[some]).sum(-1)
    best = planes[(on - _SEEN_THROUGH * seen_through).argmax()]
    return _on_surface(places @ best, values)


def _on_surface(fitted: Array, values: Array) -> Mask | None:
    """Points on a plane, if most of those beside the hole that are not nearer are; else None.

    Args:
        fitted: [N] inverse depth of the plane at the points. values: [N] that of the points.
    """
    near, beyond = _on_plane(fitted, values), int(_beyond(fitted, values).sum())
    on = int(near.sum())
    needed = max(_MIN_SUPPORT, _MIN_OF_ALL * len(values), _MIN_SHARE * (on + beyond))
    return near if on >= needed else None


def _beyond(fitted: Array, values: Array) -> Mask:
    """Points farther than a plane, which it would hide."""
    return fitted - values >= _TOLERANCE * values


def _on_plane(fitted: Array, values: Array) -> Mask:
    return np.abs(fitted - values) < _TOLERANCE * values
