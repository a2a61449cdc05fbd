"""Motion model: prediction of the camera's pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.tracking.reach import Reach, is_same_place, mean_pace, running_mean

# Changes of velocity and velocities that a camera in a hand or on a robot does not exceed.
_ACCELERATION, _ANGULAR_ACCELERATION = 10.0, 50.0
_SPEED, _ANGULAR_SPEED = 2.0, 4.0
# Error of a pose that was extrapolated from two poses.
_ERROR_M, _ERROR_RAD = 0.01, 0.02
# Time without a pose, in seconds and in intervals of frames, after which the camera may be
# elsewhere.
_GAP_S, _GAP_INTERVALS = 0.4, 5.0


class ConstantVelocity:
    """Constant velocity on SE(3), from the two newest poses (H-21)."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._poses: list[NDArray[np.float64]] = []
        self._certain, self._reliable_s, self._pace = True, 0.0, 0.0
        self._interval_s = 0.0
        self._corrected = 0

    def predict(self, timestamp_s: float) -> NDArray[np.float64]:
        """Predict T_map_camera [4, 4] at a time; the identity before the first pose."""
        if not self._poses:
            return np.eye(4)
        if len(self._poses) < 2:
            return self._poses[-1].copy()
        step = se3.log(se3.inverse(self._poses[0]) @ self._poses[1])
        elapsed = self._times[1] - self._times[0]
        # Limit the extrapolation after a gap in the sequence.
        ratio = min((timestamp_s - self._times[1]) / elapsed, 2.0)
        return self._poses[1] @ se3.exp(ratio * step)

    def restarted(self) -> ConstantVelocity:
        """A model without poses, which knows the pace of the camera."""
        model = ConstantVelocity()
        model._pace = self._pace
        return model

    def has_restarted(self) -> bool:
        """Whether the pace of the camera is known, but not its velocity since a restart."""
        return self._pace > 0.0 and self._interval_s == 0.0

    def reach(self, timestamp_s: float) -> Reach | None:
        """Where the camera may be at a time; None before the first pose."""
        if not self._poses:
            return None
        clock = max(1.0, self._pace)
        elapsed_s = clock * (timestamp_s - self._times[-1])
        if len(self._poses) < 2 or not self._certain:
            metres, radians = _SPEED * elapsed_s, _ANGULAR_SPEED * elapsed_s
        else:
            # The velocity is that in the middle of the time between both poses.
            before_s = clock * (self._times[-1] - self._times[-2])
            squared = 0.5 * elapsed_s * (elapsed_s + before_s)
            metres, radians = _ACCELERATION * squared, _ANGULAR_ACCELERATION * squared
        likeliest = self.predict(timestamp_s) if self._certain else self._poses[-1]
        return Reach(likeliest, metres + _ERROR_M, radians + _ERROR_RAD)

    def bound(self, timestamp_s: float) -> Reach | None:
        """Where the camera is at a time, whatever its velocity was; None before the first one."""
        if self._pace == 0.0:
            return None
        lost_s, doubtful_s = timestamp_s - self._times[-1], self._times[-1] - self._reliable_s
        return Reach.after(self._poses[-1], lost_s, doubtful_s, self._pace)

    def has_moved_on(self, timestamp_s: float, T_map_camera: NDArray[np.float64]) -> bool:
        """Whether a pose [4, 4] is another place than the predicted one, after a gap."""
        if not self._times or self._interval_s == 0.0:
            return False
        gap_s = timestamp_s - self._times[-1]
        if gap_s <= max(_GAP_S, _GAP_INTERVALS * self._interval_s):
            return False
        return not is_same_place(self.predict(timestamp_s), T_map_camera)

    def last(self) -> NDArray[np.float64] | None:
        """The newest pose [4, 4], or None."""
        return self._poses[-1].copy() if self._poses else None

    def update(
        self, timestamp_s: float, T_map_camera: NDArray[np.float64], reliable: bool = True
    ) -> None:
        """Add the pose [4, 4] of a tracked frame.

        Args:
            reliable: whether it is right. A motion from or to a pose that may be wrong is predicted
                to go on, but does not limit the next one.
        """
        self.forget_velocity()
        self._certain = reliable and self._times in ([], [self._reliable_s])
        self._times.append(timestamp_s)
        self._poses.append(T_map_camera.copy())
        elapsed_s = timestamp_s - self._times[0]
        if self._certain and elapsed_s > 0.0:
            step = se3.log(se3.inverse(self._poses[0]) @ T_map_camera)
            self._pace = mean_pace(self._pace, step / elapsed_s)
            self._interval_s = running_mean(self._interval_s, elapsed_s)
        if reliable:
            self._reliable_s = timestamp_s

    def forget_velocity(self) -> None:
        """Keep the newest pose but not the velocity, as after a lost frame."""
        forgotten = max(len(self._poses) - 1, 0)
        self._times, self._poses = self._times[-1:], self._poses[-1:]
        self._corrected = max(self._corrected - forgotten, 0)

    def change_frame(self, T_new_old: NDArray[np.float64]) -> None:
        """Change the coordinate frame of the map."""
        self._poses = [T_new_old @ T for T in self._poses]

    def correct(self, T_new_old: NDArray[np.float64]) -> None:
        """Correct the poses since the last correction, which were wrong by a motion [4, 4]."""
        kept = self._poses[: self._corrected]
        self._poses = kept + [T_new_old @ T for T in self._poses[self._corrected :]]
        self._corrected = len(self._poses)

    def state(self) -> dict[str, NDArray[np.float64]]:
        """Arrays for `from_state`."""
        return {
            "times": np.array(self._times),
            "poses": np.array(self._poses).reshape(-1, 4, 4),
            "corrected": np.array(self._corrected),
            "certain": np.array(self._certain),
            "reliable_s": np.array(self._reliable_s),
            "pace": np.array(self._pace),
            "interval_s": np.array(self._interval_s),
        }

    @classmethod
    def from_state(cls, state: dict[str, NDArray[np.float64]]) -> ConstantVelocity:
        """Restore a model from its `state`."""
        model = cls()
        model._times = [float(t) for t in state["times"]]
        model._poses = [np.array(pose) for pose in state["poses"]]
        model._corrected = int(state["corrected"])
        model._certain, model._pace = bool(state["certain"]), float(state["pace"])
        model._reliable_s = float(state["reliable_s"])
        model._interval_s = float(state["interval_s"])
        return model
