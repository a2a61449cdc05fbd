"""Poses from a table: the tracker of `--poses given`, for mapping alone."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.alignment.options import HealthLimits
from toolkit.frame import Frame
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.trajectory import Trajectory
from toolkit.tracking.health import may_start_map
from toolkit.tracking.result import Health, TrackingResult


class GivenPoses:
    """Looks each frame's pose up by its time; frames without one count as lost.

    The first map's frame is then the trajectory's world.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        self._T_map_world = np.eye(4)

    wants_labels = False

    def first_pose(self, frame: Frame) -> NDArray[np.float64] | None:
        """T_map_camera [4, 4] of the first frame; None without pose or anything to map."""
        if not may_start_map(HealthLimits(), frame):
            return None
        return self._trajectory.at(frame.timestamp_s)

    def prepare(self, frame: Frame, device: torch.device) -> None:
        """Nothing is done ahead of a frame's turn."""

    def track(self, frame: Frame, gaussians: GaussianCloud) -> TrackingResult:
        """The table's pose."""
        T_world_camera = self._trajectory.at(frame.timestamp_s)
        known = T_world_camera is not None
        return TrackingResult(
            T_map_camera=np.eye(4)
            if T_world_camera is None
            else self._T_map_world @ T_world_camera,
            converged=known,
            iterations=0,
            renders=0,
            intensity_residual=0.0,
            depth_residual_m=0.0,
            visible_fraction=1.0,
            information=np.zeros((6, 6)),
            health=Health.GOOD if known else Health.LOST,
            reason="" if known else "the given trajectory has no pose for it",
        )

    def change_frame(self, T_new_old: NDArray[np.float64]) -> None:
        """Go on in another frame of the map."""
        self._T_map_world = T_new_old @ self._T_map_world

    def state(self) -> dict[str, NDArray]:
        """Where the map lies; the table is read again on resume."""
        return {"T_map_world": self._T_map_world}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        self._T_map_world = np.array(state["T_map_world"])
