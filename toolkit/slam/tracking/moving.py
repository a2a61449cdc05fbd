"""Base class of the trackers with a motion model."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.slam.tracking.health import may_start_map
from toolkit.slam.tracking.motion import ConstantVelocity
from toolkit.splatting.alignment.health import HealthLimits


class MovingTracker:
    """Motion model and first pose of a tracker."""

    wants_labels = centred = gains = placed = False

    def __init__(self, limits: HealthLimits | None) -> None:
        self.limits = limits or HealthLimits()
        self.motion = ConstantVelocity()

    def first_pose(self, frame: Frame) -> NDArray[np.float64] | None:
        """The identity, because the map's frame is that of the first camera; None if unusable."""
        if not may_start_map(self.limits, frame):
            return None
        self.motion.update(frame.timestamp_s, np.eye(4))
        return np.eye(4)

    def prepare(self, frame: Frame, device: torch.device) -> None:
        """Do nothing."""

    def continue_from(self, timestamp_s: float, T_map_camera: NDArray[np.float64]) -> None:
        """Continue from a pose [4, 4], without a velocity."""
        self.motion = self.motion.restarted()
        self.motion.update(timestamp_s, T_map_camera)

    def change_frame(self, T_new_old: NDArray[np.float64]) -> None:
        """Change the coordinate frame of the map."""
        self.motion.change_frame(T_new_old)

    def correct(self, T_new_old: NDArray[np.float64]) -> None:
        """Correct the poses since the last correction, which were wrong by a motion [4, 4]."""
        self.motion.correct(T_new_old)

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        return dict(self.motion.state())

    def restore(self, state: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self.motion = ConstantVelocity.from_state(state)
