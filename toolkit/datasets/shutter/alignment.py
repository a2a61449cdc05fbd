"""Alignment of two frames whose rows are exposed one after another.

A camera with the velocity (v, w) sees a point that is at X at the time 0 at X - t (w x X + v) at
the time t. The time of a pixel is that of its row, r `readout`, with r from -0.5 to 0.5; depth is
exposed `delay` later than colour. The unknowns are the pose of one frame in the other, the
exposure, the readout time and the delay. Colour gives photometric residuals, depth point-to-plane
residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.datasets.shutter.levels import ShutterLevel

Array = NDArray[np.float64]

# Positions of the unknowns: translation, rotation, gain and bias, then readout and delay.
_POSE, _EXPOSURE, _TIMES = slice(0, 6), slice(6, 8), slice(8, 10)
_NUISANCE = slice(0, 8)
_UNKNOWNS = 10
# Maximum difference of corresponding depths, relative.
_MAX_DISTANCE = 0.05
# Residuals of this many standard deviations have half the weight.
_HALF_WEIGHT = 5.0
_MIN_PIXELS = 200
_ITERATIONS = 15
_MIN_TRANSLATION_M, _MIN_ROTATION_RAD = 2e-4, 1e-4
# Against singular equations, where an image has no texture or shows a single plane.
_RIDGE = 1e-6


@dataclass(frozen=True)
class ShutterTimes:
    """Times of a rolling shutter in seconds.

    Attributes:
        readout_s: from the exposure of the first row to that of the last.
        delay_s: from the exposure of colour to that of depth.
    """

    readout_s: float = 0.0
    delay_s: float = 0.0

    @classmethod
    def of(cls, times: Array) -> ShutterTimes:
        """From [readout, delay]."""
        return cls(float(times[0]), float(times[1]))


@dataclass(frozen=True, eq=False)
class MovingView:
    """A frame and its velocity [6] (m/s, rad/s) in its own frame."""

    levels: tuple[ShutterLevel, ShutterLevel]
    velocity: Array


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Pose T_second_first [4, 4] of two frames, and gain - 1 and bias [2] of the second one."""

    T_second_first: Array
    exposure: Array = field(default_factory=lambda: np.zeros(2))


@dataclass(frozen=True, eq=False)
class TimeEquations:
    """Normal equations over (readout, delay) of one pair, the pose and exposure eliminated.

    Attributes:
        H: [2, 2]. g: [2].
        velocity_error: error of the difference of both velocities, relative to it.
    """

    H: Array
    g: Array
    velocity_error: float = 0.0


def align(
    first: MovingView, second: MovingView, start: RelativePose, times: ShutterTimes, coarse: bool
) -> RelativePose | None:
    """Align two frames at given times of the shutter.

    Args:
        coarse: start at the coarser level.

    Returns:
        None if they cannot be aligned.
    """
    found = start
    for level in (1, 0) if coarse else (0,):
        small = False
        for _ in range(_ITERATIONS):
            equations = _linearised(first, second, found, times, level)
            if equations is None:
                return None
            H, g = equations
            step = np.asarray(np.linalg.solve(H[_NUISANCE, _NUISANCE], -g[_NUISANCE]), np.float64)
            T = se3.orthonormalise(se3.exp(step[_POSE]) @ found.T_second_first)
            found = RelativePose(T, found.exposure + step[_EXPOSURE])
            small = float(np.linalg.norm(step[:3])) < _MIN_TRANSLATION_M * 4**level
            small &= float(np.linalg.norm(step[3:6])) < _MIN_ROTATION_RAD * 4**level
            if small:
                break
    return found if small else None


def time_equations(
    first: MovingView, second: MovingView, pose: RelativePose, times: ShutterTimes
) -> TimeEquations | None:
    """Equations for corrections of the times, from two aligned frames."""
    equations = _linearised(first, second, pose, times, 0)
    if equations is None:
        return None
    H, g = equations
    known = np.column_stack([H[_NUISANCE, _TIMES], g[_NUISANCE]])
    eliminated = H[_TIMES, _NUISANCE] @ np.linalg.solve(H[_NUISANCE, _NUISANCE], known)
    return TimeEquations(H[_TIMES, _TIMES] - eliminated[:, :2], g[_TIMES] - eliminated[:, 2])


def _linearised(
    first: MovingView, second: MovingView, pose: RelativePose, times: ShutterTimes, level: int
) -> tuple[Array, Array] | None:
    """Normal equations [10, 10] and [10]; None without enough corresponding pixels."""
    a, b = first.levels[level], second.levels[level]
    if len(a.samples) < _MIN_PIXELS:
        return None
    colour = _Seen.of(a, b, first.velocity, second.velocity, pose, replace(times, delay_s=0.0))
    depth = colour
    if times.delay_s:
        depth = _Seen.of(a, b, first.velocity, second.velocity, pose, times)
    H, g = _RIDGE * np.eye(_UNKNOWNS), np.zeros(_UNKNOWNS)
    for residuals in (_photometric(a, b, colour, pose.exposure), _geometric(b, depth)):
        if residuals is None:
            return None
        r, J = residuals
        sigma = 1.4826 * float(np.median(np.abs(r))) + 1e-6
        weights = 1.0 / (sigma**2 * (1.0 + (r / (_HALF_WEIGHT * sigma)) ** 2))
        weighted = J * weights[:, None]
        H += J.T @ weighted
        g += weighted.T @ r
    return H, g


@dataclass(frozen=True, eq=False)
class _Seen:
    """Samples of the first frame in the second one.

    Attributes:
        start: [N, 3] at the time of the second frame. points: [N, 3] at the times of their rows.
        x, y: [N] pixels at which they are seen, and inside: [N] whether that is in the image.
        by_readout, by_delay: [N, 3] derivatives of the points by the times.
    """

    start: Array
    points: Array
    x: Array
    y: Array
    inside: NDArray[np.bool_]
    by_readout: Array
    by_delay: Array

    @classmethod
    def of(
        cls,
        a: ShutterLevel,
        b: ShutterLevel,
        velocity_a: Array,
        velocity_b: Array,
        pose: RelativePose,
        times: ShutterTimes,
    ) -> _Seen:
        T, camera = pose.T_second_first, b.camera
        moving_a = a.samples @ se3.hat(velocity_a[3:]).T + velocity_a[:3]
        exposed_s = times.readout_s * a.sample_rows + times.delay_s
        start = (a.samples + exposed_s[:, None] * moving_a) @ T[:3, :3].T + T[:3, 3]
        moving_a = moving_a @ T[:3, :3].T
        moving_b = start @ se3.hat(velocity_b[3:]).T + velocity_b[:3]
        points, rows = start, a.sample_rows
        # The time depends on the row at which a point is seen, and that on the time.
        for _ in range(3 if times.readout_s else 1):
            exposed_s = times.readout_s * rows + times.delay_s
            points = start - exposed_s[:, None] * moving_b
            y = camera.fy * points[:, 1] / np.maximum(points[:, 2], 1e-3) + camera.cy
            rows = (y + 0.5) / camera.height - 0.5
        x = camera.fx * points[:, 0] / np.maximum(points[:, 2], 1e-3) + camera.cx
        inside = (points[:, 2] > 0) & (x >= 1) & (x < camera.width - 2)
        inside &= (y >= 1) & (y < camera.height - 2)
        by_readout = a.sample_rows[:, None] * moving_a - rows[:, None] * moving_b
        return cls(start, points, x, y, inside, by_readout, moving_a - moving_b)


def _photometric(
    a: ShutterLevel, b: ShutterLevel, seen: _Seen, exposure: Array
) -> tuple[Array, Array] | None:
    """Residuals [M] and their derivatives [M, 10]."""
    camera = b.camera
    x, y = (c.astype(np.float32)[:, None] for c in (seen.x, seen.y))
    z = seen.points[:, 2]
    depth = cv2.remap(b.points[..., 2], x, y, cv2.INTER_NEAREST)[:, 0]
    kept = seen.inside & (depth > 0) & (np.abs(depth - z) < _MAX_DISTANCE * z)
    if kept.sum() < _MIN_PIXELS:
        return None
    x, y, z, points = x[kept], y[kept], z[kept], seen.points[kept]
    intensity = cv2.remap(b.intensity, x, y, cv2.INTER_LINEAR)[:, 0].astype(np.float64)
    gradients = (1.0 + exposure[0]) * cv2.remap(b.gradients, x, y, cv2.INTER_LINEAR)[:, 0]
    along_x, along_y = camera.fx * gradients[:, 0] / z, camera.fy * gradients[:, 1] / z
    along_z = -(along_x * points[:, 0] + along_y * points[:, 1]) / z
    J = _derivatives(np.stack([along_x, along_y, along_z], axis=1), seen, kept)
    J[:, 6], J[:, 7] = intensity, 1.0
    J[:, 9] = 0.0
    return (1.0 + exposure[0]) * intensity + exposure[1] - a.sample_intensity[kept], J


def _geometric(b: ShutterLevel, seen: _Seen) -> tuple[Array, Array] | None:
    """Residuals [M] in units of the sensor's noise at a depth of 1 m, and derivatives [M, 10]."""
    kept = np.flatnonzero(seen.inside)
    at = np.rint(seen.y[kept]).astype(np.intp), np.rint(seen.x[kept]).astype(np.intp)
    normals = b.normals[at].astype(np.float64)
    z = seen.points[kept, 2]
    distance = np.einsum("ij,ij->i", seen.points[kept] - b.points[at], normals)
    near = (normals[:, 2] != 0) & (np.abs(distance) < _MAX_DISTANCE * z)
    if near.sum() < _MIN_PIXELS:
        return None
    weight = 1.0 / z[near] ** 2
    J = _derivatives(normals[near] * weight[:, None], seen, kept[near])
    return distance[near] * weight, J


def _derivatives(by_point: Array, seen: _Seen, kept: NDArray) -> Array:
    """Derivatives [M, 10] of residuals, from those [M, 3] by the points."""
    J = np.zeros((len(by_point), _UNKNOWNS))
    J[:, :3] = by_point
    (nx, ny, nz), (x, y, z) = by_point.T, seen.start[kept].T
    J[:, 3], J[:, 4], J[:, 5] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
    J[:, 8] = np.einsum("ij,ij->i", by_point, seen.by_readout[kept])
    J[:, 9] = np.einsum("ij,ij->i", by_point, seen.by_delay[kept])
    return J
