"""Camera paths of a hand-held camera: smooth, with a small sway.

Camera axes are x right, y down, z forward; the world is z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3

# A stop: frames in which the camera stands still, and those in which it slows down before and
# speeds up after it.
STILL_FRAMES, _RAMP_FRAMES = 20, 15
# Translation and rotation per frame at walking pace and 30 Hz.
_STEP_M = 0.0155
_TURN_RAD = math.radians(1.27)


@dataclass(frozen=True)
class WayPoint:
    """A camera position and its target point, in metres."""

    position_m: tuple[float, float, float]
    target_m: tuple[float, float, float]


@dataclass(frozen=True)
class Gait:
    """How the camera is carried.

    Attributes:
        tilt: factor of the usual sway in yaw, pitch and roll (up to 0.9 degrees).
        stop: fraction of the path at which the camera slows down and stands still for a moment;
            None if it keeps its pace.
    """

    tilt: float = 1.0
    stop: float | None = None


_STEADY = Gait()


def look_at(position_m: NDArray, target_m: NDArray) -> NDArray[np.float64]:
    """Return the pose [4, 4] at a position [3] that looks at a target [3], without roll."""
    forward = np.asarray(target_m, float) - position_m
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    return se3.from_rotation_translation(np.stack([right, down, forward], axis=1), position_m)


def hand_held_path(
    way_points: tuple[WayPoint, ...],
    frames: int | None,
    share: float,
    rng: np.random.Generator,
    gait: Gait = _STEADY,
) -> NDArray[np.float64]:
    """Return poses [frames, 4, 4] along way points at constant pace but for a stop, with sway.

    Args:
        way_points: at least three.
        frames: number of poses; None for walking pace at 30 Hz.
        share: fraction of the path to use, in (0, 1].
        rng: source of randomness of the sway.
        gait: how the camera is carried.
    """
    dense = _spline(way_points, 200 * len(way_points))
    pace = _evenly_paced(dense)
    if frames is None:
        frames = max(2, round(share * _pace_length(dense) / _STEP_M))
        if gait.stop is not None:
            frames += STILL_FRAMES + _RAMP_FRAMES
    progress = np.linspace(0.0, share, frames)
    if gait.stop is not None:
        progress = _with_stop(progress, gait.stop)
    moments = np.interp(progress, pace, np.linspace(0.0, 1.0, len(dense)))
    position, angles = _at(dense, moments)
    # The sway depends on the travelled distance: a shorter path is a prefix of a longer one.
    sway = _sway(progress * _pace_length(dense), rng)
    sway[:, 3:] *= gait.tilt
    return np.stack(
        [_pose(p + s[:3], a + s[3:5], s[5]) for p, a, s in zip(position, angles, sway, strict=True)]
    )


def _with_stop(progress: NDArray[np.float64], place: float) -> NDArray[np.float64]:
    """Return the progress [N] along a path on which the camera stands still at about `place`.

    Args:
        progress: [N] at constant pace.
        place: in the units of `progress`.
    """
    pace = np.ones(len(progress) - 1)
    first = int(np.searchsorted(progress, place))
    slower = np.linspace(1.0, 0.0, _RAMP_FRAMES, endpoint=False)
    dip = np.concatenate([slower, np.zeros(STILL_FRAMES - 1), slower[::-1]])
    end = min(first + len(dip), len(pace))
    pace[first:end] = dip[: max(0, end - first)]
    way = np.concatenate([[0.0], np.cumsum(pace)])
    return np.asarray(progress[-1] * way / (way[-1] or 1.0))


def _spline(way_points: tuple[WayPoint, ...], count: int) -> NDArray[np.float64]:
    """Return points [count, 5] on a cubic spline through the way points: position, yaw, pitch."""
    positions = np.array([w.position_m for w in way_points])
    forward = np.array([w.target_m for w in way_points]) - positions
    yaw = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    pitch = np.arctan2(forward[:, 2], np.hypot(forward[:, 0], forward[:, 1]))
    knots = np.concatenate([positions, yaw[:, None], pitch[:, None]], axis=1)
    return _catmull_rom(knots, count)


def _catmull_rom(knots: NDArray, count: int) -> NDArray[np.float64]:
    padded = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    place = np.linspace(0.0, len(knots) - 1.0, count)
    first = np.minimum(place.astype(int), len(knots) - 2)
    s = (place - first)[:, None]
    a, b, c, d = (padded[first + k] for k in range(4))
    curve = b + 0.5 * s * (c - a + s * (2 * a - 5 * b + 4 * c - d + s * (3 * (b - c) + d - a)))
    # The acceleration of Catmull-Rom splines jumps at the knots; a wide average smooths it.
    width = max(3, count // (2 * len(knots)) | 1)
    kernel = np.hanning(width + 2)[1:-1]
    kernel /= kernel.sum()
    ends = np.pad(curve, ((width // 2, width // 2), (0, 0)), mode="reflect", reflect_type="odd")
    return np.stack([np.convolve(column, kernel, mode="valid") for column in ends.T], axis=1)


def _effort(dense: NDArray) -> NDArray[np.float64]:
    """Return the length of each step in metres, including an equivalent length for rotation."""
    change = np.diff(dense, axis=0)
    turn = np.hypot(change[:, 3] * np.cos(dense[:-1, 4]), change[:, 4])
    walk = np.linalg.norm(change[:, :3], axis=1)
    # A soft maximum, because translation and rotation happen simultaneously.
    return (walk**4 + (turn * _STEP_M / _TURN_RAD) ** 4) ** 0.25


def _pace_length(dense: NDArray) -> float:
    """Return the total effort of a path, metres."""
    return float(_effort(dense).sum())


def _evenly_paced(dense: NDArray) -> NDArray[np.float64]:
    total = np.concatenate([[0.0], np.cumsum(_effort(dense))])
    return total / total[-1]


def _at(dense: NDArray, moments: NDArray) -> tuple[NDArray, NDArray]:
    grid = np.linspace(0.0, 1.0, len(dense))
    values = np.stack([np.interp(moments, grid, column) for column in dense.T], axis=1)
    return values[:, :3], values[:, 3:]


def _sway(way_m: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return small smooth motions [N, 6]: x, y, z (m), yaw, pitch, roll (rad)."""
    reach = np.array([0.012, 0.012, 0.018, 0.012, 0.012, 0.015])
    out = np.zeros((len(way_m), 6))
    for wavelength_m, weight in ((1.3, 0.65), (0.55, 0.35)):
        phase = rng.uniform(0.0, 2 * math.pi, 6)
        stretch = rng.uniform(0.8, 1.25, 6)
        out += weight * np.sin(2 * math.pi * way_m[:, None] / wavelength_m * stretch + phase)
    return out * reach


def _pose(position: NDArray, yaw_pitch_rad: NDArray, roll_rad: float) -> NDArray[np.float64]:
    yaw, pitch = yaw_pitch_rad
    direction = [math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)]
    T = look_at(position, position + np.array(direction))
    T[:3, :3] = T[:3, :3] @ se3.exp_so3(np.array([0.0, 0.0, roll_rad]))
    return T
