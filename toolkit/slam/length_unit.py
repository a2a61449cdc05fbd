"""The unit of length in which a system works, for scenes much smaller or larger than rooms.

Tolerances, noise models and sizes are those of rooms, in metres. A scene at 6 cm or 90 m is
multiplied by a power of two, which is exact, so that it has the size of a room; whatever leaves
the system is in metres again. Rooms keep the metre, and every bit of their results.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.keyframe import Keyframe
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.findings import is_impossible_depth, length, median_depths_m
from toolkit.datasets.samples import evenly_spaced, readable
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.result import FrameResult, SeparatePart, SlamResult, TrackedFrames
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.tracking.result import TrackingResult
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.scene import InMemoryScene

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

# Median depths of scenes that keep the metre, and the one that others come near to.
_ROOMS_M, _TYPICAL_M = (0.5, 8.0), 2.0
# Number of frames whose depth is looked at.
_FRAMES = 6


@dataclass(frozen=True)
class LengthUnit:
    """Conversion between metres and the unit of a system.

    Attributes:
        per_metre: units per metre, a power of two.
    """

    per_metre: float = 1.0

    @classmethod
    def of(cls, dataset: Dataset | None) -> LengthUnit | None:
        """The unit for a recording, from the depth of a few frames; metres for other datasets.

        Returns:
            None without a dataset: it follows from the first frame (`of_frame`).
        """
        if dataset is None:
            return None
        if not isinstance(dataset, RecordedDataset) or dataset.files(0).depth is None:
            return cls()
        return cls.of_frames(readable(dataset.__getitem__, evenly_spaced(len(dataset), _FRAMES)))

    @classmethod
    def of_frames(cls, frames: Iterable[Frame]) -> LengthUnit:
        """The unit for a recording of which these are evenly spaced frames."""
        medians_m = median_depths_m(frames)
        return cls._of_median(float(np.median(medians_m))) if medians_m else cls()

    @classmethod
    def of_frame(cls, frame: Frame) -> LengthUnit | None:
        """The unit that suits a frame, None without depth.

        A depth that no sensor measures is warned of; `quick_findings` does this for recordings.
        """
        # Simulators write infinity for the sky.
        depth_m = frame.depth_m[np.isfinite(frame.depth_m) & (frame.depth_m > 0)]
        if not depth_m.size:
            return None
        median_m = float(np.median(depth_m))
        if is_impossible_depth([median_m]):
            _log.warning(
                "The median depth of frame %d is %s; depth must be in metres.",
                frame.index,
                length(median_m),
            )
        return cls._of_median(median_m)

    @classmethod
    def _of_median(cls, median_m: float) -> LengthUnit:
        if _ROOMS_M[0] <= median_m <= _ROOMS_M[1]:
            return cls()
        return cls(2.0 ** round(math.log2(_TYPICAL_M / median_m)))

    @property
    def is_metre(self) -> bool:
        """Whether nothing is converted."""
        return self.per_metre == 1.0

    @property
    def _metres(self) -> LengthUnit:
        """The inverse conversion."""
        return LengthUnit(1.0 / self.per_metre)

    def frame(self, frame: Frame) -> Frame:
        """A frame in metres, in this unit."""
        if self.is_metre:
            return frame
        return replace(frame, depth_m=frame.depth_m * np.float32(self.per_metre))

    def pose(self, T: Array) -> Array:
        """Poses [..., 4, 4] in metres, in this unit."""
        if self.is_metre:
            return T
        scaled = np.array(T, np.float64)
        scaled[..., :3, 3] *= self.per_metre
        return scaled

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory in metres, in this unit."""
        return Trajectory(trajectory.timestamps_s, self.pose(trajectory.T_world_camera))

    def cloud(self, cloud: GaussianCloud) -> GaussianCloud:
        """Gaussians in metres, in this unit."""
        if self.is_metre:
            return cloud
        return cloud.scaled(self.per_metre)

    def submap(self, submap: Submap) -> Submap:
        """A submap in metres, in this unit."""
        if self.is_metre:
            return submap
        return replace(
            submap,
            T_world_submap=self.pose(submap.T_world_submap),
            gaussians=self.cloud(submap.gaussians),
            keyframes=[self._keyframe(keyframe) for keyframe in submap.keyframes],
            views=[],  # which only the run itself compares
        )

    def _keyframe(self, keyframe: Keyframe) -> Keyframe:
        def scaled(depth_m: torch.Tensor | None) -> torch.Tensor | None:
            return None if depth_m is None else depth_m * self.per_metre

        return replace(
            keyframe,
            T_map_camera=self.pose(keyframe.T_map_camera),
            depth_m=keyframe.depth_m * self.per_metre,
            points=keyframe.points * np.float32(self.per_metre),
            # The state of optimisers, which start again in another run.
            pose_moments=None,
            prior_m=scaled(keyframe.prior_m),
            observed_m=scaled(keyframe.observed_m),
        )

    def submap_in_metres(self, submap: Submap) -> Submap:
        """A submap of the system, in metres."""
        return self._metres.submap(submap)

    def cloud_in_metres(self, cloud: GaussianCloud) -> GaussianCloud:
        """Gaussians of the system, in metres."""
        return self._metres.cloud(cloud)

    def pose_in_metres(self, T: Array) -> Array:
        """Poses [..., 4, 4] of the system, in metres."""
        return self._metres.pose(T)

    def record_in_metres(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """A record of the log of loops, whose keys name the unit, in metres."""
        if self.is_metre:
            return dict(record)
        converted = dict(record)
        for name, value in record.items():
            if name.endswith("_m") and isinstance(value, float):
                converted[name] = value / self.per_metre
            elif name.startswith("T_"):
                T = np.reshape(value, (4, 4)).astype(np.float64)
                converted[name] = self.pose_in_metres(T).ravel().tolist()
        return converted

    def frame_result_in_metres(self, result: FrameResult) -> FrameResult:
        """The result of a frame in metres."""
        if self.is_metre:
            return result
        poses = (result.T_map_camera, result.T_world_camera)
        T_map_camera, T_world_camera = (
            None if T is None else self.pose_in_metres(T) for T in poses
        )
        return replace(
            result,
            T_map_camera=T_map_camera,
            T_world_camera=T_world_camera,
            tracking=None if result.tracking is None else self._tracking(result.tracking),
        )

    def _tracking(self, tracking: TrackingResult) -> TrackingResult:
        return replace(
            tracking,
            T_map_camera=self.pose_in_metres(tracking.T_map_camera),
            depth_residual_m=tracking.depth_residual_m / self.per_metre,
            information=self._information(tracking.information),
            covariance=None
            if tracking.covariance is None
            else self._covariance(tracking.covariance),
        )

    def _covariance(self, covariances: Array) -> Array:
        """Covariances [..., 6, 6] in metres."""
        scales = np.array([1.0 / self.per_metre] * 3 + [1.0] * 3)
        return covariances * np.outer(scales, scales)

    def _information(self, information: Array) -> Array:
        scales = np.array([self.per_metre] * 3 + [1.0] * 3)
        return information * np.outer(scales, scales)

    def result_in_metres(self, result: SlamResult) -> SlamResult:
        """The result of a run in metres."""
        if self.is_metre:
            return result
        main = self._frames(
            TrackedFrames(
                result.trajectory,
                result.frame_indices,
                result.frame_submaps,
                result.exposures,
                result.covariances,
            )
        )
        return replace(
            result,
            trajectory=main.trajectory,
            covariances=main.covariances,
            submaps=[
                replace(s, T_world_submap=self.pose_in_metres(s.T_world_submap))
                for s in result.submaps
            ],
            loops=[self._edge(edge) for edge in result.loops],
            map=self._map(result.map),
            other_parts=[self._part(part) for part in result.other_parts],
            units_per_metre=self.per_metre,
        )

    def _frames(self, frames: TrackedFrames) -> TrackedFrames:
        covariances = frames.covariances
        if covariances is not None:
            covariances = self._covariance(covariances)
        trajectory = self._metres.trajectory(frames.trajectory)
        return replace(frames, trajectory=trajectory, covariances=covariances)

    def _edge(self, edge: PoseEdge) -> PoseEdge:
        return replace(
            edge,
            T_first_second=self.pose_in_metres(edge.T_first_second),
            information=self._information(edge.information),
        )

    def _map(self, scene: FusedMap | InMemoryScene) -> FusedMap | InMemoryScene:
        if isinstance(scene, InMemoryScene):
            return InMemoryScene(self.cloud_in_metres(scene.gaussians))
        return scene.converted(self.submap_in_metres)

    def _part(self, part: SeparatePart) -> SeparatePart:
        scene = None if part.map is None else part.map.converted(self.submap_in_metres)
        return replace(part, frames=self._frames(part.frames), map=scene)


METRE = LengthUnit()
