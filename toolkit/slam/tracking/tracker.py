"""Interface of the trackers."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.slam.tracking.proposals import Proposals
from toolkit.slam.tracking.result import TrackingResult
from toolkit.splatting.alignment.health import HealthLimits
from toolkit.splatting.gaussians.cloud import GaussianCloud


class Tracker(Protocol):
    """Estimates the pose of each frame against the map.

    Attributes:
        wants_labels: whether frames must be labelled before they are tracked.
        centred: whether colours of Gaussians may be centred; not if rendered pixels are compared.
        gains: whether the exposures of keyframes are to be estimated.
        placed: whether poses of new keyframes are to be refined against earlier keyframes.
    """

    wants_labels: bool
    centred: bool
    gains: bool
    placed: bool

    def first_pose(self, frame: Frame) -> NDArray[np.float64] | None:
        """T_map_camera [4, 4] of the frame that starts the map; None if it cannot start one."""
        ...

    def prepare(self, frame: Frame, device: torch.device) -> None:
        """Do work for a later frame that does not depend on the map; from any thread."""
        ...

    def track(
        self, frame: Frame, gaussians: GaussianCloud, proposals: Proposals | None = None
    ) -> TrackingResult:
        """Estimate the pose of the next frame against the Gaussians.

        Args:
            proposals: further initial poses, which are asked for if the frame is doubtful.
        """
        ...

    def change_frame(self, T_new_old: NDArray[np.float64]) -> None:
        """Change the coordinate frame of the map: all poses become T_new_old @ T_old_camera."""
        ...

    def correct(self, T_new_old: NDArray[np.float64]) -> None:
        """Correct the poses since the last correction, which were wrong by a motion [4, 4]."""
        ...

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        ...

    def restore(self, state: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        ...


@runtime_checkable
class LocatingTracker(Tracker, Protocol):
    """A tracker that can also locate a frame anywhere in a map, and continue from there."""

    limits: HealthLimits

    def locate(
        self,
        frame: Frame,
        gaussians: GaussianCloud,
        T_map_camera: NDArray[np.float64],
        /,
        *,
        search: bool = True,
    ) -> TrackingResult:
        """Locate a frame near an initial pose [4, 4]; the tracker's state does not change.

        Args:
            search: look for other initial poses if the result is not clear.
        """
        ...

    def continue_from(self, timestamp_s: float, T_map_camera: NDArray[np.float64]) -> None:
        """Continue from a pose [4, 4], without a velocity."""
        ...


@runtime_checkable
class PartTracker(Tracker, Protocol):
    """A tracker that knows poses in several parts, whose relative poses are unknown."""

    def pose_in_other_part(self, frame: Frame) -> NDArray[np.float64] | None:
        """Pose [4, 4] of a frame in the world frame of a part other than the map's, if any."""
        ...

    def enter(self, frame: Frame) -> None:
        """Continue in the part of such a frame, in a map whose frame is that of the camera."""
        ...
