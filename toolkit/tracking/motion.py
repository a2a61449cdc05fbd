"""Where the camera probably is before anything is measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3


class ConstantVelocity:
    """Repeats the last motion on SE(3), scaled by time (H-21)."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._poses: list[NDArray[np.float64]] = []

    def predict(self, timestamp_s: float) -> NDArray[np.float64]:
        """T_map_camera [4, 4] expected at a time; the identity before the first pose."""
        if not self._poses:
            return np.eye(4)
        if len(self._poses) < 2:
            return self._poses[-1].copy()
        step = se3.log(se3.inverse(self._poses[0]) @ self._poses[1])
        elapsed = self._times[1] - self._times[0]
        # A gap in the sequence must not fling the camera away.
        share = min((timestamp_s - self._times[1]) / elapsed, 2.0)
        return self._poses[1] @ se3.exp(share * step)

    def last(self) -> NDArray[np.float64] | None:
        """The newest pose, or None."""
        return self._poses[-1].copy() if self._poses else None

    def update(self, timestamp_s: float, T_map_camera: NDArray[np.float64]) -> None:
        """Accept a pose."""
        self._times = [*self._times, timestamp_s][-2:]
        self._poses = [*self._poses, T_map_camera.copy()][-2:]

    def forget_velocity(self) -> None:
        """Keep the place but not the motion, as after a lost frame."""
        self._times, self._poses = self._times[-1:], self._poses[-1:]

    def change_frame(self, T_new_old: NDArray[np.float64]) -> None:
        """Express the poses in another frame of the map."""
        self._poses = [T_new_old @ T for T in self._poses]

    def state(self) -> dict[str, NDArray[np.float64]]:
        """Arrays that `from_state` restores."""
        return {
            "times": np.array(self._times),
            "poses": np.array(self._poses).reshape(-1, 4, 4),
        }

    @classmethod
    def from_state(cls, state: dict[str, NDArray[np.float64]]) -> ConstantVelocity:
        """The model that `state` came from."""
        model = cls()
        model._times = [float(t) for t in state["times"]]
        model._poses = [np.array(pose) for pose in state["poses"]]
        return model
