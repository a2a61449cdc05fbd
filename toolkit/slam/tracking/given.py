"""Tracker of `--poses given`, which takes the poses from a trajectory: mapping only."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.slam.tracking.health import may_start_map
from toolkit.slam.tracking.proposals import Proposals
from toolkit.slam.tracking.result import Health, TrackingResult
from toolkit.splatting.alignment.health import HealthLimits
from toolkit.splatting.gaussians.cloud import GaussianCloud


class GivenPoses:
    """Looks up the pose of each frame by its timestamp; frames without a pose are lost.

    The frame of the first submap is the world frame of the trajectory.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        self._T_map_world = np.eye(4)

    wants_labels = centred = gains = placed = False
    # Why a frame without a pose is lost.
    without_pose = "the dataset has no pose for it"

    def first_pose(self, frame: Frame) -> NDArray[np.float64] | None:
        """T_map_camera [4, 4] of the first frame; None if it has no pose or cannot be mapped."""
        if not may_start_map(HealthLimits(), frame):
            return None
        return self._trajectory.at(frame.timestamp_s)

    def prepare(self, frame: Frame, device: torch.device) -> None:
        """Do nothing."""

    def track(
        self,
        frame: Frame,
        gaussians: GaussianCloud,
        proposals: Proposals | None = None,
    ) -> TrackingResult:
        """Return the pose of the trajectory."""
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
            reason="" if known else self.without_pose,
        )

    def change_frame(self, T_new_old: NDArray[np.float64]) -> None:
        """Change the coordinate frame of the map."""
        # T_new_old is the inverse of a pose that contains T_map_world: rounding errors would double
        # with each submap, and poses would be useless after about 50 of them.
        self._T_map_world = se3.orthonormalise(T_new_old @ self._T_map_world)

    def correct(self, T_new_old: NDArray[np.float64]) -> None:
        """Change the coordinate frame of the map: given poses are relative to each other."""
        self.change_frame(T_new_old)

    def state(self) -> dict[str, NDArray]:
        """Pose of the world in the map; the trajectory is read again when a run is resumed."""
        return {"T_map_world": self._T_map_world}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._T_map_world = np.array(state["T_map_world"])
