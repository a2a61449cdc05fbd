"""What the SLAM system returns for a frame and for a sequence."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toolkit.exposure import IDENTITY, Exposure
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.gaussians.scene import InMemoryScene
from toolkit.geometry.trajectory import Trajectory
from toolkit.mapping.mapper import MappingResult
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.pose_graph.graph import PoseEdge
from toolkit.refinement.fusion import FusedMap
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.submaps.allocation import AllocationVerdict
from toolkit.tracking.result import TrackingResult


@dataclass(frozen=True)
class FrameResult:
    """Result of one frame.

    Attributes:
        index: the frame's index in its sequence.
        T_map_camera: [4, 4] float64 pose in the frame of the active submap, or None if the
            frame is lost.
        tracking: the tracker's result; None for the frame that started the map. Its status is LOST
            for a frame that could not be located and started a submap of unknown position.
        mapping: result of mapping; None unless the frame became a keyframe of an existing submap.
        T_world_camera: the same pose in the world frame; loop closure may change it later.
        keyframe: whether the frame became a keyframe.
        dropped: whether the frame was not processed (`Slam.drop_frame`).
    """

    index: int
    T_map_camera: NDArray[np.float64] | None
    tracking: TrackingResult | None
    mapping: MappingResult | None = None
    T_world_camera: NDArray[np.float64] | None = None
    keyframe: bool = False
    dropped: bool = False

    @property
    def lost(self) -> bool:
        """Whether the frame has no pose."""
        return self.T_map_camera is None

    @property
    def doubtful(self) -> bool:
        """Whether the pose may be wrong; `reason` states why."""
        return not self.lost and self.tracking is not None and self.tracking.doubtful

    @property
    def reason(self) -> str:
        """Why the frame is doubtful or lost; empty if it is neither."""
        if not (self.lost or self.doubtful):
            return ""
        return "" if self.tracking is None else self.tracking.reason


@dataclass(frozen=True, eq=False)
class SubmapSummary:
    """One submap of a run.

    Attributes:
        number: in order of creation, from 0.
        T_world_submap: [4, 4] pose of its anchor.
        keyframe_indices: frame indices of its keyframes, in order.
        readable: False if its file was lost or damaged when the run was resumed.
        exposure: its exposure relative to the map; the identity before `finish`.
    """

    number: int
    T_world_submap: NDArray[np.float64]
    keyframe_indices: list[int]
    readable: bool
    exposure: Exposure = IDENTITY


@dataclass(frozen=True, eq=False)
class SlamResult:
    """The state of a run; final once it was returned by `Slam.finish`.

    Attributes:
        trajectory: M poses in the world, the first submap's frame, of the tracked frames.
        frame_indices: [M] indices of the tracked frames, in order.
        exposures: [M] exposures of the tracked frames against the map; before `finish`, against
            the frame's submap.
        lost_frames: reason by index of the frames without a pose, in order.
        doubtful_frames: reason by index of the frames whose pose may be wrong, in order. They did
            not extend the map.
        frame_submaps: [M] number of the submap of each tracked frame.
        parts: numbers of the submaps of each part of the map, the part of the most frames first.
            The relative poses of different parts are unknown.
        keyframe_indices: frame indices of all keyframes of this sequence, in order. A keyframe on
            the boundary of two submaps counts once; those of a loaded map do not count.
        submaps: all submaps by number.
        allocation: the decisions whether a keyframe starts a submap.
        loops: the accepted loop edges between submaps.
        map: the fused map in the world's frame; before `finish`, the active submap.
        semantics: decodes the features of the map; without channels for a map without semantics.
        taxonomy: the classes of the map, None for a map without semantics.
        covariances: [M, 6, 6] of x in T_world_camera exp(x), x = (translation m, rotation rad);
            None before `finish` and without loop closure.
        dropped_frames: indices of the frames that were not processed. They have the pose of the
            frame before, or are lost as well.
    """

    trajectory: Trajectory
    frame_indices: list[int]
    exposures: list[Exposure]
    lost_frames: dict[int, str]
    keyframe_indices: list[int]
    submaps: list[SubmapSummary]
    allocation: list[AllocationVerdict]
    loops: list[PoseEdge]
    map: FusedMap | InMemoryScene = field(repr=False)
    semantics: SemanticMapping = field(repr=False)
    taxonomy: Taxonomy | None = field(repr=False)
    covariances: NDArray[np.float64] | None = field(default=None, repr=False)
    dropped_frames: list[int] = field(default_factory=list)
    doubtful_frames: dict[int, str] = field(default_factory=dict)
    frame_submaps: list[int] = field(default_factory=list)
    parts: list[tuple[int, ...]] = field(default_factory=list)

    @property
    def gaussians(self) -> GaussianCloud:
        """All Gaussians of the map, in memory."""
        return self.map.gaussians
