"""Short windows of consecutive frames, whose alignment gives the velocity of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.datasets.shutter.alignment import (
    MovingView,
    RelativePose,
    ShutterTimes,
    TimeEquations,
    align,
    time_equations,
)
from toolkit.datasets.shutter.levels import ShutterLevel, shutter_levels

Array = NDArray[np.float64]

# Frames on each side of a frame from which its velocity is computed: five poses give it without
# the error of a difference quotient, which flattens the peaks of a shaking hand.
_REACH = 2
# Shorter windows contain no pair of frames with a velocity.
MIN_FRAMES = 2 * _REACH + 3
# Pairs of a window whose velocities differ most, with frames at least that far apart.
_PAIRS = 5
_MIN_STEP = 2
# Error of a velocity, as a share of the second difference of the velocities between frames.
_BEND_SHARE = 0.2
# Frames whose second differences are larger, relative to the speed, have wrong times, or the
# camera hardly moves.
_MAX_BEND = 1.0


@dataclass(eq=False)
class ShutterWindow:
    """Frames of a window, their velocities, and pairs of them with different velocities.

    Attributes:
        levels: of each of the N frames.
        times_s: [N] of the frames.
        steps: pose of each frame in the next one.
        velocities: [N, 6] m/s and rad/s, each in its own frame.
        roughness: [N] errors of the velocities in rad/s.
        regular: [N] whether a velocity is known.
        pairs: pose in the second frame, by the indices of both.
    """

    levels: list[tuple[ShutterLevel, ShutterLevel]]
    times_s: Array
    steps: list[RelativePose]
    velocities: Array
    roughness: Array
    regular: NDArray[np.bool_]
    pairs: dict[tuple[int, int], RelativePose]

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> ShutterWindow | None:
        """Align the frames of a window; None if that fails.

        Args:
            frames: at least `MIN_FRAMES`, consecutive, with depth.
        """
        levels = [shutter_levels(frame, seed) for seed, frame in enumerate(frames)]
        times_s = np.array([frame.timestamp_s for frame in frames])
        count = len(frames)
        start = [RelativePose(np.eye(4))] * (count - 1)
        still, unknown = np.zeros((count, 6)), np.zeros(count, np.bool_)
        window = cls(levels, times_s, start, still, np.zeros(count), unknown, {})
        if not window._align_steps(ShutterTimes(), coarse=True):
            return None
        window._choose_pairs()
        return window

    def equations(self, times: ShutterTimes, coarse: bool) -> list[TimeEquations]:
        """Normal equations of the pairs that can be aligned, for corrections of the times.

        Args:
            times: the current estimate.
            coarse: whether the pairs were not aligned before.
        """
        if not self.pairs:
            return []
        if times != ShutterTimes() and not self._align_steps(times, coarse=False):
            return []
        found = []
        for (i, j), start in list(self.pairs.items()):
            first, second = self._view(i), self._view(j)
            pose = align(first, second, start, times, coarse)
            if pose is None:
                continue
            self.pairs[i, j] = pose
            equations = time_equations(first, second, pose, times)
            if equations is not None:
                found.append(replace(equations, velocity_error=self._velocity_error(i, j)))
        return found

    def _view(self, index: int) -> MovingView:
        return MovingView(self.levels[index], self.velocities[index])

    def _align_steps(self, times: ShutterTimes, coarse: bool) -> bool:
        """Align neighbouring frames and compute the velocities; False if these are not known."""
        steps: list[RelativePose] = []
        for index, known in enumerate(self.steps):
            start = steps[-1] if coarse and steps else known
            found = align(self._view(index), self._view(index + 1), start, times, coarse)
            if found is None:
                return False
            steps.append(found)
        self.steps = steps
        poses = self._poses()
        numbers, times_s = range(len(poses)), self.times_s
        self.velocities = np.array([_velocity(poses, times_s, n) for n in numbers])
        # Steps of a hand change gradually. Frames with wrong times, and images that were delivered
        # twice, make single steps shorter or longer; so does a hand that shakes too fast for the
        # frame rate.
        moved = np.array([-se3.log(step.T_second_first) for step in steps])
        means = moved / np.diff(times_s)[:, None]
        bends = np.array([self._size(bend) for bend in np.diff(means, n=2, axis=0)])
        speeds = np.array([self._size(mean) for mean in means])
        for n in range(_REACH, len(poses) - _REACH):
            bend = np.sqrt(np.mean(bends[n - _REACH : n + _REACH - 2] ** 2))
            self.roughness[n] = _BEND_SHARE * bend
            regular = bend <= _MAX_BEND * speeds[n - _REACH : n + _REACH].mean()
            self.regular[n] = regular
        return True

    def _velocity_error(self, i: int, j: int) -> float:
        """Error of the difference of two velocities, relative to it."""
        difference = self._size(self.velocities[j] - self.velocities[i])
        return float(np.hypot(self.roughness[i], self.roughness[j]) / max(difference, 1e-9))

    def _size(self, velocity: Array) -> float:
        """Approximate speed in rad/s at which a velocity [6] moves the image."""
        depth_m = float(np.median(self.levels[0][1].samples[:, 2]))
        return float(np.linalg.norm(velocity[3:]) + np.linalg.norm(velocity[:3]) / depth_m)

    def _poses(self) -> list[Array]:
        """Pose [4, 4] of each frame in the first one."""
        poses = [np.eye(4)]
        for step in self.steps:
            poses.append(poses[-1] @ se3.inverse(step.T_second_first))
        return poses

    def _choose_pairs(self) -> None:
        """Choose the pairs whose velocities differ most."""
        poses = self._poses()
        inner = np.flatnonzero(self.regular)
        change = {}
        for i in inner:
            for j in inner:
                if j - i >= _MIN_STEP:
                    change[i, j] = self._size(self.velocities[j] - self.velocities[i])
        for i, j in sorted(change, key=lambda pair: -change[pair]):
            near = any(abs(i - a) + abs(j - b) < _MIN_STEP for a, b in self.pairs)
            if len(self.pairs) < _PAIRS and not near:
                self.pairs[int(i), int(j)] = RelativePose(se3.inverse(poses[j]) @ poses[i])


def _velocity(poses: Sequence[Array], times_s: Array, index: int) -> Array:
    """Velocity [6] at one of the poses: that of the polynomial through its neighbours."""
    around = range(max(index - _REACH, 0), min(index + _REACH + 1, len(poses)))
    others = [n for n in around if n != index]
    moved = np.array([se3.log(se3.inverse(poses[index]) @ poses[n]) for n in others])
    elapsed = times_s[others] - times_s[index]
    powers = elapsed[:, None] ** np.arange(1, len(others) + 1)
    return np.asarray(np.linalg.solve(powers, moved)[0])
