"""Tracking of frames without depth near a trajectory that is known roughly.

The map is rendered at the given pose. That view has depth, so that the frame can be aligned to it
by its intensities alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.frame import Frame, NullRecorder, Recorder
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.stages import Stage
from toolkit.slam.tracking.given import GivenPoses
from toolkit.slam.tracking.proposals import Proposals
from toolkit.slam.tracking.result import TrackingResult
from toolkit.slam.tracking.views import MapRenderer, RenderedView, apparent_motion
from toolkit.splatting.alignment.backend import align
from toolkit.splatting.alignment.data import (
    INITIAL_SCALES,
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    ModelLevel,
)
from toolkit.splatting.alignment.exposure import estimate_exposure
from toolkit.splatting.alignment.levels import finest_level, pyramid
from toolkit.splatting.gaussians.cloud import GaussianCloud

# Given poses are wrong by one or two pixels.
_LEVELS = 2
_ITERATIONS = 10
# Fraction of the image that the map must cover.
_MIN_COVERED = 0.3
_MAX_DISTANCE = 0.1
# Depth is the view's own, and must not hold the frame at the pose of the view.
_PHOTOMETRIC_WEIGHT = 1e7
# A larger correction, the sum of rotation and of translation at the median depth, is a failure.
_MAX_CORRECTION_PX = 8.0


class GuidedTracker(GivenPoses):
    """Aligns each frame to the map, starting at its pose in a trajectory.

    Frames with depth keep their pose, and only their exposure is estimated. Where the map covers
    too little of the image, or alignment fails, the pose is the given one.

    Args:
        trajectories: poses of the frames, wrong by a few pixels. A trajectory of several parts,
            whose relative poses are unknown, has one of them for each part.
    """

    gains = True
    without_pose = "the motion of the camera could not be estimated there"

    def __init__(
        self,
        trajectories: Sequence[Trajectory],
        backend_name: str = "auto",
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(trajectories[0])
        self._trajectories, self._part = trajectories, 0
        self._recorder = recorder or NullRecorder()
        self._renderer = MapRenderer(backend_name, self._recorder)
        self._exposure = IDENTITY

    def first_pose(self, frame: Frame) -> NDArray[np.float64] | None:
        """T_map_camera [4, 4] of the first frame; None if it has no pose or cannot be mapped."""
        self._continue_in(self._part_of(frame))
        return super().first_pose(frame)

    def pose_in_other_part(self, frame: Frame) -> NDArray[np.float64] | None:
        """Pose [4, 4] of a frame in the world frame of a part other than the map's, if any."""
        part = self._part_of(frame)
        return None if part == self._part else self._trajectories[part].at(frame.timestamp_s)

    def enter(self, frame: Frame) -> None:
        """Continue in the part of such a frame, in a map whose frame is that of the camera."""
        self._continue_in(self._part_of(frame))
        T_world_camera = self._trajectory.at(frame.timestamp_s)
        assert T_world_camera is not None, "the part has a pose of it"
        self._T_map_world = se3.inverse(T_world_camera)
        self._exposure = IDENTITY

    def _part_of(self, frame: Frame) -> int:
        """Number of the part that has a pose of a frame; the present one if none has."""
        known = [n for n, t in enumerate(self._trajectories) if t.at(frame.timestamp_s) is not None]
        return known[0] if known else self._part

    def _continue_in(self, part: int) -> None:
        self._part, self._trajectory = part, self._trajectories[part]

    def track(
        self,
        frame: Frame,
        gaussians: GaussianCloud,
        proposals: Proposals | None = None,
    ) -> TrackingResult:
        """Align a frame to the Gaussians; its exposure is relative to the map."""
        given = super().track(frame, gaussians)
        if given.lost:
            return given
        T_map_view = given.T_map_camera
        view = self._renderer.view(gaussians, frame.camera, T_map_view, _LEVELS)
        depth_m = view.images[0].depth_m
        known = depth_m[depth_m > 0]
        if len(known) < _MIN_COVERED * depth_m.numel():
            return given
        with self._recorder.timed(Stage.TRACKING_ALIGN):
            found, exposure = self._aligned(frame, view)
        correction = apparent_motion(found.T_view_camera, float(known.median()))
        if not correction * frame.camera.focal < _MAX_CORRECTION_PX:
            return given
        self._exposure = exposure
        # Frames with depth extend the map. At their given poses, it does not drift.
        extends = bool(frame.depth_m.any())
        return replace(
            given,
            T_map_camera=T_map_view
            if extends
            else se3.orthonormalise(T_map_view @ found.T_view_camera),
            converged=found.converged,
            iterations=found.iterations,
            renders=1,
            intensity_residual=found.scales.intensity,
            exposure=exposure,
        )

    def _aligned(self, frame: Frame, view: RenderedView) -> tuple[Alignment, Exposure]:
        """The frame's pose relative to a view of the map, and its exposure."""
        models, depth_m = view.levels, view.images[0].depth_m
        own = finest_level(frame, depth_m.device)
        frames = pyramid(FrameLevel(frame.camera, own.intensity, depth_m), _LEVELS)
        # The given pose is good enough to detect a sudden change of exposure.
        unaligned = Alignment(np.eye(4), INITIAL_SCALES, self._exposure)
        start = _exposure(models, frames, unaligned)
        options = GaussNewtonOptions(
            iterations=_ITERATIONS,
            max_distance=_MAX_DISTANCE,
            photometric_weight=_PHOTOMETRIC_WEIGHT,
            exposure=start,
        )
        found = align(models, frames, Alignment(np.eye(4), INITIAL_SCALES, start), options)
        return found, _exposure(models, frames, found)

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        exposure = np.array([self._exposure.gain, self._exposure.bias])
        return super().state() | {"exposure": exposure, "part": np.array(self._part)}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        super().restore(state)
        self._exposure = Exposure(*(float(value) for value in state["exposure"]))
        self._continue_in(int(state["part"]))


def _exposure(models: list[ModelLevel], frames: list[FrameLevel], alignment: Alignment) -> Exposure:
    """Exposure of a frame at a pose relative to a view."""
    return estimate_exposure(
        list(zip(models, frames, strict=True)),
        alignment.T_view_camera,
        alignment.scales,
        alignment.exposure,
        _MAX_DISTANCE,
    )
