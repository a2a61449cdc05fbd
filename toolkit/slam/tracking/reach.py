"""Where the camera may be, and which of several poses that explain a frame is likely.

What repeats looks the same at several poses. The camera is at the one that it can have reached; if
it can have reached more than one of them, the frame alone does not tell where it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.tracking.evidence import likeness, quality
from toolkit.slam.tracking.result import Health, TrackingResult
from toolkit.slam.tracking.views import Task

# Poses that are farther apart (`Task.distance`) are different ones, and explain a frame equally
# well if the likeness, and what is visible of it, are these fractions of those at the best one.
_ANOTHER, _AS_GOOD, _AS_MUCH = 0.04, 0.95, 0.75
# Distance from the pose of the features of a pose that is elsewhere.
_ELSEWHERE = 0.3
# How far a camera that somebody carries has moved while it was lost, and how wrong the pose of a
# frame that was doubtful for so long can be, in metres and radians per second; and both from the
# start.
_LOST_M_S, _LOST_RAD_S = 1.5, 2.0
_DOUBTFUL_M_S, _DOUBTFUL_RAD_S = 0.8, 0.6
_ANYHOW_M, _ANYHOW_RAD = 0.5, 0.5
# Poses that are farther apart than this are those of different places.
_APART_M, _APART_RAD = 0.3, 0.3
# Part of a new value in the mean of the last ones.
_NEW = 0.2
REPEATS = "what it shows repeats: several poses fit"


@dataclass(frozen=True)
class Reach:
    """The poses that a camera may have reached.

    Attributes:
        T_map_camera: [4, 4] the likeliest one.
        metres, radians: how far it may be from that.
    """

    T_map_camera: NDArray[np.float64]
    metres: float
    radians: float

    @classmethod
    def after(
        cls, T_map_camera: NDArray[np.float64], lost_s: float, doubtful_s: float, pace: float
    ) -> Reach:
        """The poses that a lost camera can have reached.

        Args:
            T_map_camera: [4, 4] the last pose.
            lost_s: time since then. doubtful_s: time for which that pose had been doubtful.
            pace: mean of the velocities before (`mean_pace`).
        """
        lost_s, doubtful_s = max(1.0, pace) * lost_s, max(1.0, pace) * doubtful_s
        metres = _ANYHOW_M + _LOST_M_S * lost_s + _DOUBTFUL_M_S * doubtful_s
        radians = _ANYHOW_RAD + _LOST_RAD_S * lost_s + _DOUBTFUL_RAD_S * doubtful_s
        return cls(T_map_camera, metres, radians)

    def contains(self, T_map_camera: NDArray[np.float64]) -> bool:
        """Whether a pose [4, 4] can be the camera's."""
        motion = se3.inverse(self.T_map_camera) @ T_map_camera
        near = float(np.linalg.norm(motion[:3, 3])) <= self.metres
        return near and float(se3.rotation_angle_rad(motion[:3, :3])) <= self.radians


def is_same_place(first: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
    """Whether two poses [4, 4] are so near each other that a camera sees the same from both."""
    return Reach(first, _APART_M, _APART_RAD).contains(second)


def is_only_place(
    T_map_camera: NDArray[np.float64],
    others: Iterable[NDArray[np.float64]],
    possible: Callable[[NDArray[np.float64]], bool],
) -> bool:
    """Whether a camera is at a place if what it sees looks like others, too.

    Where a door looks like the next one, the one after that may not have been seen yet: another
    place counts at its distance, in both directions.

    Args:
        T_map_camera: [4, 4] at the place. others: [4, 4] each, at the others.
        possible: whether the camera can be at a pose.
    """
    for T_other in others:
        if is_same_place(T_map_camera, T_other):
            continue
        T_opposite = se3.orthonormalise(T_map_camera @ se3.inverse(T_other) @ T_map_camera)
        if possible(T_other) or possible(T_opposite):
            return False
    return True


def running_mean(mean: float, new: float) -> float:
    """Mean of the last values; 0 before the first one."""
    return new if mean == 0.0 else mean + _NEW * (new - mean)


def mean_pace(pace: float, velocity: NDArray[np.float64]) -> float:
    """Mean of the last velocities as a fraction of that of a lost camera.

    It is above 1 if the clock is wrong: images without times count as those of 30 per second,
    however far the camera moved between them.

    Args:
        pace: the mean before; 0 without any.
        velocity: [6] of the camera (m/s, rad/s).
    """
    metres, radians = (float(np.linalg.norm(part)) for part in np.split(velocity, 2))
    return running_mean(pace, max(metres / _LOST_M_S, radians / _LOST_RAD_S))


def likeliest(task: Task, results: Sequence[TrackingResult], reach: Reach | None) -> TrackingResult:
    """The best result or, if others explain the frame as well, the one nearest to the prediction.

    The latter is doubtful unless it is the only one that the camera can have reached.
    """
    best = max(results, key=by_evidence)
    if reach is None or best.lost or not (best.health is Health.GOOD or best.ambiguous):
        return best
    fitting = [one for one in results if not one.lost and _fits_as_well(one, best)]
    nearest = min(fitting, key=lambda one: task.distance(reach.T_map_camera, one.T_map_camera))
    if task.distance(best.T_map_camera, nearest.T_map_camera) < _ANOTHER:
        nearest = best
    others = [
        one for one in fitting if task.distance(one.T_map_camera, nearest.T_map_camera) > _ANOTHER
    ]
    possible = [one for one in others if reach.contains(one.T_map_camera)]
    if not others or (reach.contains(nearest.T_map_camera) and not possible):
        return nearest
    return replace(doubted(nearest, REPEATS), ambiguous=True)


def unless_contradicted(task: Task, result: TrackingResult, reach: Reach | None) -> TrackingResult:
    """The result, or a lost one if the camera cannot have reached it and the features moved on.

    The next stretch of a corridor, and the same one seen the other way, look like this one.
    """
    features, T_map_camera = task.features, result.T_map_camera
    if features is None or features.motions is not None or reach is None:
        return result
    near = task.distance(features.T_map_camera, T_map_camera) < _ELSEWHERE
    if near or reach.contains(T_map_camera):
        return result
    return contradicted(result, "features were followed to another place")


def contradicted(result: TrackingResult, reason: str) -> TrackingResult:
    """A lost result instead of one at a place that looks the same."""
    return replace(result, health=Health.LOST, reason=reason, ambiguous=True)


def _fits_as_well(result: TrackingResult, best: TrackingResult) -> bool:
    """Whether a result explains about as much of the frame as the best one, and as well."""
    first, second = result.similarity, best.similarity
    alike = likeness(first) >= _AS_GOOD * likeness(second)
    return alike and quality(first) >= _AS_MUCH * quality(second)


def doubted(result: TrackingResult, reason: str) -> TrackingResult:
    """The result, doubtful if there is a reason and it counted as good."""
    if not reason or result.health is not Health.GOOD:
        return result
    return replace(result, health=Health.DOUBTFUL, reason=reason)


def by_evidence(result: TrackingResult) -> tuple[bool, float]:
    """Order of the results of a frame: those with a pose first, then by their evidence."""
    return not result.lost, quality(result.similarity)
