"""Delay and unit of ground-truth poses, found from an estimated trajectory.

A wrong clock or unit of the truth is no error of the estimate, and must not pass for one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.trajectory import AlignmentKind, absolute_trajectory_error

Array = NDArray[np.float64]

# Delays that are tried, in intervals of the frames, and their upper limit in seconds.
_DELAYS, _MAX_DELAY_S = np.arange(-12.0, 12.25, 0.25), 0.5
# Motions over so many frames are compared: drift hardly matters to them. In metres and radians,
# what counts as no motion.
_SPAN, _STILL_M, _STILL_RAD = 5, 0.01, 0.01
# A delay is reported if it reduces the differences to this part in each half of the frames, and is
# the best one in both, up to a number of intervals.
_EXPLAINED, _SAME_DELAY, _MIN_POSES = 0.6, 1.0, 24
# A unit is reported if it differs by this part, reduces the ATE of each half of the frames as much,
# and is the same in both, up to this part.
_LEAST_SCALE, _SAME_SCALE = 0.04, 0.02


@dataclass(frozen=True)
class PoseDelay:
    """By how much later than its frame a true pose was recorded.

    Attributes:
        delay_s: seconds, negative for poses that are early.
        rmse_m: ATE with the truth at the times plus the delay, in metres.
    """

    delay_s: float
    rmse_m: float


def pose_delay(estimate: Trajectory, truth: Trajectory, kind: AlignmentKind) -> PoseDelay | None:
    """The delay of true poses with which they move as the estimate does; None if none does.

    Args:
        estimate: poses at the times of their frames.
        truth: poses by a clock that may be late or early.
        kind: of the alignment for the ATE.
    """
    if len(estimate) < _MIN_POSES or len(truth) < 2:
        return None
    interval_s = float(np.median(np.diff(estimate.timestamps_s)))
    delays_s = _DELAYS * interval_s
    delays_s = delays_s[np.abs(delays_s) <= _MAX_DELAY_S]
    # The same frames are compared at all delays.
    first_s, last_s = truth.timestamps_s[0] - delays_s[0], truth.timestamps_s[-1] - delays_s[-1]
    known = (estimate.timestamps_s >= first_s) & (estimate.timestamps_s <= last_s)
    times_s = estimate.timestamps_s[known]
    if len(times_s) < _MIN_POSES:
        return None
    own = _Motions(estimate, times_s)
    errors = np.array([own.differences(_Motions(truth, times_s + d)) for d in delays_s])
    zero, half = int(np.argmin(np.abs(delays_s))), errors.shape[1] // 2
    best = int(np.argmin(np.median(errors, axis=1)))
    for part in (errors[:, :half], errors[:, half:]):
        found = np.median(part, axis=1)
        unlike = abs(delays_s[np.argmin(found)] - delays_s[best]) > _SAME_DELAY * interval_s
        if unlike or found[best] >= _EXPLAINED * found[zero]:
            return None
    delay_s = float(delays_s[best])
    try:
        ate = absolute_trajectory_error(estimate, truth.delayed(delay_s), kind)
    except DatasetError:
        return None  # too few poses are left
    return PoseDelay(delay_s, ate.rmse_m)


@dataclass(frozen=True)
class PoseScale:
    """The unit of true poses against that of depth.

    Attributes:
        factor: of estimated positions, and so of depth, with which they agree.
        rmse_m: ATE with that factor, in metres of the truth.
    """

    factor: float
    rmse_m: float


def pose_scale(estimate: Trajectory, truth: Trajectory) -> PoseScale | None:
    """The factor of depth that explains most of the ATE; None if none does.

    Args:
        estimate: poses in the unit of depth.
        truth: poses in a unit that may be another one.
    """
    if len(estimate) < _MIN_POSES:
        return None
    half = estimate.timestamps_s[len(estimate) // 2]
    first = estimate.timestamps_s < half
    found = []
    for part in (np.ones_like(first), first, ~first):
        chosen = Trajectory(estimate.timestamps_s[part], estimate.T_world_camera[part])
        try:
            rigid, scaled = (absolute_trajectory_error(chosen, truth, k) for k in ("se3", "sim3"))
        except DatasetError:
            return None  # a half has no true poses
        if scaled.rmse_m >= _EXPLAINED * rigid.rmse_m:
            return None
        found.append((scaled.alignment.scale, scaled.rmse_m))
    factor, rmse_m = found[0]
    logs = np.log([scale for scale, _ in found])
    known = abs(logs[0]) > _LEAST_SCALE and np.abs(logs - logs[0]).max() < _SAME_SCALE
    return PoseScale(factor, rmse_m) if known else None


class _Motions:
    """Motions over some frames, in the camera's frame.

    Attributes:
        translations_m: [N, 3]
        rotations: N of them.
    """

    def __init__(self, trajectory: Trajectory, times_s: Array) -> None:
        poses = trajectory.interpolated(times_s)
        turned, positions = Rotation.from_matrix(poses[:, :3, :3]), poses[:, :3, 3]
        back = turned[:-_SPAN].inv()
        self.translations_m = back.apply(positions[_SPAN:] - positions[:-_SPAN])
        self.rotations = back * turned[_SPAN:]

    def differences(self, others: _Motions) -> Array:
        """Differences [N] from others, relative to their size, whatever the scale is."""
        own, true = self.translations_m, others.translations_m
        scale = (own * true).sum() / max((own**2).sum(), 1e-12)
        metres = np.linalg.norm(scale * own - true, axis=1)
        radians = (self.rotations.inv() * others.rotations).magnitude()
        usual_m = np.hypot(np.linalg.norm(true, axis=1).mean(), _STILL_M)
        usual_rad = np.hypot(others.rotations.magnitude().mean(), _STILL_RAD)
        return np.hypot(metres / usual_m, radians / usual_rad)
