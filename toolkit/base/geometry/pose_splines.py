"""Smooth camera paths through given poses."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from toolkit.base.geometry import se3

Array = NDArray[np.float64]

# A rotation of one radian takes as long as a translation of this length.
_METRES_PER_RADIAN = 0.7
# Poses that are closer to each other are one: a spline needs distinct places.
_MIN_STEP = 1e-4


def pose_spline(T_world_camera: Array, count: int) -> Array:
    """Return poses [count, 4, 4] on a smooth path through given poses [N, 4, 4], N >= 1.

    The path has continuous velocity, and passes through the poses at nearly constant speed, where
    rotations count as translations. A single pose gives a camera that does not move.

    Args:
        T_world_camera: poses in order.
        count: number of poses, >= 2; the first and the last one are those given.
    """
    steps = [_step(a, b) for a, b in itertools.pairwise(T_world_camera)]
    kept = np.concatenate([[True], np.array(steps) > _MIN_STEP]).astype(bool)
    poses = T_world_camera[kept]
    if len(poses) == 1:
        return np.repeat(poses, count, axis=0)
    lengths = [_step(a, b) for a, b in itertools.pairwise(poses)]
    knots = np.concatenate([[0.0], np.cumsum(lengths)])
    places = np.linspace(0.0, knots[-1], count)
    positions_m = CubicSpline(knots, poses[:, :3, 3])(places)
    rotations = RotationSpline(knots, Rotation.from_matrix(poses[:, :3, :3]))(places).as_matrix()
    path = np.tile(np.eye(4), (count, 1, 1))
    path[:, :3, :3], path[:, :3, 3] = rotations, positions_m
    return path


def thinned(T_world_camera: Array, min_step: float) -> Array:
    """Return a subset of poses [N, 4, 4] with at least a step between them, and the last one.

    A spline through fewer poses is smoother.

    Args:
        min_step: minimum translation in metres, to which rotations are added.
    """
    kept = [0]
    for index in range(1, len(T_world_camera)):
        if _step(T_world_camera[kept[-1]], T_world_camera[index]) >= min_step:
            kept.append(index)
    last = len(T_world_camera) - 1
    if kept[-1] != last:
        # Replace the last but one, unless it is the first.
        kept = [*(kept[:-1] if len(kept) > 1 else kept), last]
    return T_world_camera[kept]


def _step(T_world_a: Array, T_world_b: Array) -> float:
    T_a_b = se3.inverse(T_world_a) @ T_world_b
    angle_rad = float(se3.rotation_angle_rad(T_a_b[:3, :3]))
    return float(np.linalg.norm(T_a_b[:3, 3])) + _METRES_PER_RADIAN * angle_rad
