"""Unit of depth, delay and jumps of given poses, from the motion that images show.

Pairs of frames are aligned by depth and colour. If poses are late, the motion at other times agrees
better; if the unit of depth is wrong, all distances differ by one factor; where a pose jumps, the
images do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.agreement.pairs import FramePair
from toolkit.datasets.jackknife import jackknife_sigmas

Array = NDArray[np.float64]

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
    if not _are_enough(np.array([pair.first for pair in pairs])):
        return PoseAgreement()
    own = _Motions(pairs, times_s)
    interval_s = float(np.median(np.diff(times_s)))
    delays_s = _DELAYS * interval_s
    delays_s = delays_s[np.abs(delays_s) <= _MAX_DELAY_S]
    delayed = own.given(given, delays_s)
    errors = np.array([own.errors(motions) for motions in delayed])
    best = _certain_delay(errors, delays_s, own.anchors, interval_s)
    return PoseAgreement(float(delays_s[best]), _certain_factor(own, delayed[best]))


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


class _Motions:
    """The motions between pairs of frames by images, and by given poses.

    Attributes:
        anchors: [P] first frames. translations: [P, 3] by images.
    """

    def __init__(self, pairs: Sequence[FramePair], times_s: Array) -> None:
        self.anchors = np.array([pair.first for pair in pairs])
        self._T = np.array([pair.pose.T_second_first for pair in pairs])
        self.translations = self._T[:, :3, 3]
        self._times_s = times_s[np.array([(pair.first, pair.second) for pair in pairs])]
        self._depths_m = np.array([pair.depth_m for pair in pairs])

    def given(self, poses: Trajectory, delays_s: Array) -> Array:
        """T_second_first [D, P, 4, 4] by the poses at delays [D]; NaN without poses there."""
        times_s = self._times_s + delays_s[:, None, None]
        both = poses.interpolated(times_s.ravel()).reshape(*times_s.shape, 4, 4)
        return np.asarray(se3.inverse(both[:, :, 1]) @ both[:, :, 0])

    def errors(self, given: Array) -> Array:
        """Differences [P] from given motions [P, 4, 4], whatever the unit of depth is.

        They are in radians, at the depth of the scene; NaN where no motion is given.
        """
        known, errors = ~np.isnan(given[:, 0, 3]), np.full(len(given), np.nan)
        if known.any():
            own = self._T[known]
            own[:, :3, 3] *= _factor(own[:, :3, 3], given[known, :3, 3])
            apart = se3.inverse(own) @ given[known]
            metres = np.linalg.norm(apart[:, :3, 3], axis=1)
            angles_rad = se3.rotation_angle_rad(apart[:, :3, :3])
            errors[known] = np.hypot(metres / self._depths_m[known], angles_rad)
        return errors


def _are_enough(anchors: NDArray[np.int64]) -> bool:
    """Whether pairs that begin at these frames tell anything."""
    return len(anchors) >= _MIN_PAIRS and len(set(anchors.tolist())) >= _MIN_ANCHORS


def _certain_delay(errors: Array, delays_s: Array, anchors: NDArray, interval_s: float) -> int:
    """The number of the delay [D] that explains errors [D, P]; that of 0 if none does."""
    none = int(np.argmin(np.abs(delays_s)))
    known = ~np.isnan(errors).any(axis=0)
    errors, anchors = errors[:, known], anchors[known]
    if not _are_enough(anchors):
        return none
    costs = _trimmed_means(errors)
    best = int(np.argmin(costs))
    if costs[best] > _EXPLAINED * costs[none]:
        return none
    others = [
        delays_s[np.argmin(_trimmed_means(errors[:, anchors != anchor]))] for anchor in set(anchors)
    ]
    certain = np.abs(np.array(others) - delays_s[best]).max() <= _SAME_DELAY * interval_s
    return best if certain else none


def _certain_factor(own: _Motions, given: Array) -> float:
    """The factor of depth that explains the translations of motions [P, 4, 4]; 1 if none does."""
    known = ~np.isnan(given[:, 0, 3])
    if known.sum() < _MIN_PAIRS:
        return 1.0
    seen, stated, anchors = own.translations[known], given[known, :3, 3], own.anchors[known]
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
