"""Unit of depth, delay and jumps of given poses, from the motion that images show.

Pairs of frames are aligned by depth and colour. If poses are late, the motion at other times agrees
better; if the unit of depth is wrong, all distances differ by one factor; where a pose jumps, the
images do not.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.agreement.pairs import FramePair
from toolkit.datasets.jackknife import jackknife_sigmas
from toolkit.geometry import se3
from toolkit.geometry.trajectory import Trajectory

Array = NDArray[np.float64]
# The pose [4, 4] at a time, None outside of the poses.
PoseAt = Callable[[float], Array | None]

# Delays that are tried, in intervals of the frames, and their upper limit in seconds.
_DELAYS, _MAX_DELAY_S = np.arange(-12.0, 12.5, 0.5), 0.5
# Part of the pairs that count: others may show moving objects, or are aligned wrongly.
_TRUSTED = 0.75
# A delay is reported if it reduces the disagreement to this part, and is the same (in intervals)
# without any one of the frames that pairs begin at.
_EXPLAINED, _SAME_DELAY = 0.6, 1.0
# A factor of depth is reported if it differs from 1 by so much, and by so many standard errors.
_LEAST_FACTOR, _CERTAIN = 0.04, 5.0
_MIN_PAIRS, _MIN_ANCHORS = 6, 4
# Poses jump if the step between two frames differs by so much from the mean of those beside it,
# in metres, radians and usual differences, and from the motion of the images.
_JUMP_M, _JUMP_RAD, _JUMP_USUAL, _MOST_JUMPS = 0.04, 0.035, 8.0, 5


@dataclass(frozen=True)
class PoseAgreement:
    """What images say about given poses.

    Attributes:
        delay_s: by how much later than its frame a pose was recorded; 0 if that is uncertain.
        depth_factor: factor of the depths with which they agree; 1 if that is uncertain.
    """

    delay_s: float = 0.0
    depth_factor: float = 1.0


def judge_given(pairs: Sequence[FramePair], times_s: Array, given: Trajectory) -> PoseAgreement:
    """Compare given poses with the motion of images.

    Args:
        pairs: frames and their motion by images.
        times_s: [N] times of all frames.
        given: poses by these times.
    """
    own = [_Motion(pair, times_s) for pair in pairs]
    if len(own) < _MIN_PAIRS or len({motion.anchor for motion in own}) < _MIN_ANCHORS:
        return PoseAgreement()
    interval_s = float(np.median(np.diff(times_s)))
    delays_s = _DELAYS * interval_s
    delays_s = delays_s[np.abs(delays_s) <= _MAX_DELAY_S]
    pose_at = functools.cache(given.interpolated)
    errors = np.array([_errors(own, pose_at, float(delay_s)) for delay_s in delays_s])
    delay_s = _certain_delay(errors, delays_s, np.array([m.anchor for m in own]), interval_s)
    return PoseAgreement(delay_s, _certain_factor(own, pose_at, delay_s))


@dataclass(frozen=True, eq=False)
class SuddenStep:
    """A step between two given poses that differs much from those before and after.

    Attributes:
        index: of the first of both poses.
        stated: [6] the step. expected: [6] one that goes on as those beside it.
    """

    index: int
    stated: Array
    expected: Array

    def is_jump(self, pair: FramePair) -> bool:
        """Whether the camera did not make the step.

        The images show another motion, which is like that before and after.

        Args:
            pair: the frames of both poses.
        """
        T_first_second = se3.inverse(pair.pose.T_second_first)
        difference = se3.log(se3.inverse(T_first_second) @ se3.exp(self.stated))
        limits = np.array([_JUMP_M, _JUMP_RAD])
        seen, stated = (
            _sizes(step - self.expected) for step in (se3.log(T_first_second), self.stated)
        )
        jumps = (_sizes(difference) > limits).any()
        return bool(jumps and (seen <= np.maximum(0.5 * stated, limits)).all())


def sudden_steps(given: Trajectory) -> list[SuddenStep]:
    """The steps between given poses that differ most from those before and after, in order."""
    if len(given) < _JUMP_USUAL:
        return []
    poses, elapsed_s = given.T_world_camera, np.diff(given.timestamps_s)[:, None]
    steps = np.array([se3.log(se3.inverse(a) @ b) for a, b in pairwise(poses)])
    rates = steps / elapsed_s
    beside = 0.5 * (np.roll(rates, 1, axis=0) + np.roll(rates, -1, axis=0))
    beside[0], beside[-1] = rates[1], rates[-2]
    expected = beside * elapsed_s
    sizes = np.array([_sizes(change) for change in steps - expected])
    limits = np.maximum([_JUMP_M, _JUMP_RAD], _JUMP_USUAL * np.median(sizes, axis=0))
    excess = (sizes / limits).max(axis=1)
    # The steps beside a jump differ from it, too, by half as much.
    highest = [n for n in range(len(excess)) if excess[n] >= excess[max(n - 1, 0) : n + 2].max()]
    found = sorted((n for n in highest if excess[n] > 1.0), key=lambda n: -excess[n])
    return [SuddenStep(n, steps[n], expected[n]) for n in sorted(found[:_MOST_JUMPS])]


def _sizes(step: Array) -> Array:
    """Metres and radians [2] of a step [6]."""
    return np.array([np.linalg.norm(step[:3]), np.linalg.norm(step[3:])])


class _Motion:
    """The motion between two frames by images, and by given poses."""

    def __init__(self, pair: FramePair, times_s: Array) -> None:
        self.anchor = pair.first
        self._T = pair.pose.T_second_first
        self._times_s = float(times_s[pair.first]), float(times_s[pair.second])
        self._depth_m = pair.depth_m

    def given(self, pose_at: PoseAt, delay_s: float) -> Array | None:
        """T_second_first [4, 4] by the poses a time later; None without poses there."""
        first, second = (pose_at(t + delay_s) for t in self._times_s)
        return None if first is None or second is None else se3.inverse(second) @ first

    def translations(self, pose_at: PoseAt, delay_s: float) -> tuple[Array, Array] | None:
        """Translations [3] by images and by poses."""
        T = self.given(pose_at, delay_s)
        return None if T is None else (self._T[:3, 3], T[:3, 3])

    def error(self, pose_at: PoseAt, delay_s: float, factor: float) -> float:
        """Size of the difference in radians, at the depth of the scene; NaN without poses."""
        T = self.given(pose_at, delay_s)
        if T is None:
            return float("nan")
        own = self._T.copy()
        own[:3, 3] *= factor
        metres, radians = _sizes(se3.log(se3.inverse(own) @ T))
        return float(np.hypot(metres / self._depth_m, radians))


def _errors(own: Sequence[_Motion], pose_at: PoseAt, delay_s: float) -> list[float]:
    """Errors [P] of the motions at a delay, whatever the unit of depth is."""
    found = [t for motion in own if (t := motion.translations(pose_at, delay_s)) is not None]
    factor = _factor(*(np.array([t[k] for t in found]) for k in (0, 1))) if found else 1.0
    return [motion.error(pose_at, delay_s, factor) for motion in own]


def _certain_delay(errors: Array, delays_s: Array, anchors: NDArray, interval_s: float) -> float:
    """The delay that explains errors [D, P]; 0 if none does."""
    known = ~np.isnan(errors).any(axis=0)
    errors, anchors = errors[:, known], anchors[known]
    if len(anchors) < _MIN_PAIRS or len(set(anchors)) < _MIN_ANCHORS:
        return 0.0
    costs = _trimmed_means(errors)
    best = int(np.argmin(costs))
    if costs[best] > _EXPLAINED * costs[np.argmin(np.abs(delays_s))]:
        return 0.0
    delay_s = float(delays_s[best])
    others = [
        delays_s[np.argmin(_trimmed_means(errors[:, anchors != anchor]))] for anchor in set(anchors)
    ]
    certain = np.abs(np.array(others) - delay_s).max() <= _SAME_DELAY * interval_s
    return delay_s if certain else 0.0


def _certain_factor(own: Sequence[_Motion], pose_at: PoseAt, delay_s: float) -> float:
    """The factor of depth that explains the translations; 1 if none does."""
    found = [(m, m.translations(pose_at, delay_s)) for m in own]
    known = [(m, t) for m, t in found if t is not None]
    if len(known) < _MIN_PAIRS:
        return 1.0
    seen, stated = (np.array([t[k] for _, t in known]) for k in (0, 1))
    anchors = np.array([m.anchor for m, _ in known])
    # Noise of the translations by images, and of the given ones, brings one of these factors each
    # towards zero: the right one is between them. A camera that hardly moves has a wide range.
    by_seen, by_stated = _factor(seen, stated), _factor(stated, seen)
    if by_seen <= 0.0 or by_stated <= 0.0:
        return 1.0
    low, high = np.log(by_seen), -np.log(by_stated)
    others = [anchors != anchor for anchor in set(anchors)]
    sigma = float(jackknife_sigmas(np.array([_factor(seen[o], stated[o]) for o in others])))
    least = max(_LEAST_FACTOR, _CERTAIN * sigma)
    uncertain = low < least and high > -least
    return 1.0 if uncertain else float(np.exp(0.5 * (low + high)))


def _factor(seen: Array, stated: Array) -> float:
    """Factor of translations [N, 3] that agrees with others, without the pairs that disagree.

    Where a texture repeats, a pair may be aligned by a period off, and longest translations are the
    wrong ones. Least squares alone would follow them.
    """
    products, squares = (seen * stated).sum(axis=1), np.maximum((seen**2).sum(axis=1), 1e-12)
    factor = float(np.median(products / squares))
    for _ in range(3):
        errors = np.linalg.norm(factor * seen - stated, axis=1)
        kept = errors <= np.quantile(errors, _TRUSTED)
        factor = float(products[kept].sum() / squares[kept].sum())
    return factor


def _trimmed_means(errors: Array) -> Array:
    """Means [D] of the smallest of errors [D, P]."""
    kept = max(int(_TRUSTED * errors.shape[1]), 1)
    return np.sort(errors, axis=1)[:, :kept].mean(axis=1)
