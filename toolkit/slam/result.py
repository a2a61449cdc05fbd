"""What the SLAM system returns for a frame and for a sequence."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.camera_path import CameraPath
from toolkit.slam.mapping.consensus import LabelAgreement
from toolkit.slam.mapping.mapper import MappingResult
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.submaps.allocation import AllocationVerdict
from toolkit.slam.tracking.result import TrackingResult
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.scene import InMemoryScene


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
        T_world_camera: the same pose in the world frame; loop closure may change it later. Where a
            submap has started at a lost frame, its pose relative to earlier submaps is unknown, and
            this one is arbitrary, until a loop joins the two (`Slam.parts`).
        keyframe: whether the frame became a keyframe.
        dropped: whether the frame was not processed (`Slam.drop_frame`).
        submap: number of the submap of the frame; None if the frame is lost.
    """

    index: int
    T_map_camera: NDArray[np.float64] | None
    tracking: TrackingResult | None
    mapping: MappingResult | None = None
    T_world_camera: NDArray[np.float64] | None = None
    keyframe: bool = False
    dropped: bool = False
    submap: int | None = None

    @property
    def lost(self) -> bool:
        """Whether the frame has no pose."""
        return self.T_map_camera is None

    @property
    def doubtful(self) -> bool:
        """Whether the pose may be wrong; see `reason`."""
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
        T_world_submap: [4, 4] pose of its anchor in the frame of its part of the map.
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
class TrackedFrames:
    """The frames with a pose in one frame of reference.

    Attributes:
        trajectory: M poses.
        indices: [M] frame indices, in order.
        submaps: [M] number of the submap of each frame.
        exposures: [M] exposures against the map.
        covariances: [M, 6, 6] of x in T_world_camera exp(x); None if unknown.
    """

    trajectory: Trajectory
    indices: list[int]
    submaps: list[int]
    exposures: list[Exposure]
    covariances: NDArray[np.float64] | None = None

    def of(
        self,
        submaps: Collection[int],
        T_part_world: NDArray[np.float64],
        doubtful: Collection[int] = (),
    ) -> TrackedFrames:
        """The frames of some submaps, transformed by [4, 4], without doubtful ones."""
        numbered = zip(self.indices, self.submaps, strict=True)
        chosen = [
            k
            for k, (index, number) in enumerate(numbered)
            if number in submaps and index not in doubtful
        ]
        poses = self.trajectory.T_world_camera[chosen]
        if not np.array_equal(T_part_world, np.eye(4)):
            poses = np.array([se3.orthonormalise(T_part_world @ T) for T in poses])
        return TrackedFrames(
            Trajectory(self.trajectory.timestamps_s[chosen], poses.reshape(-1, 4, 4)),
            [self.indices[k] for k in chosen],
            [self.submaps[k] for k in chosen],
            [self.exposures[k] for k in chosen],
            None if self.covariances is None else self.covariances[chosen],
        )


@dataclass(frozen=True)
class Loss:
    """Where the camera was lost.

    Attributes:
        index: of the first frame that was not tracked reliably.
        reason: why it was not.
    """

    index: int
    reason: str


def loss_before(index: int, lost: Mapping[int, str], doubtful: Mapping[int, str]) -> Loss | None:
    """Find where the camera was lost in the frames before one; None if all was well.

    Args:
        index: of the frame at which a part of the map starts.
        lost, doubtful: reasons by frame index.
    """
    unreliable = {**doubtful, **lost}
    before = list(takewhile(unreliable.__contains__, range(index - 1, -1, -1)))[::-1]
    if not before:
        return None
    first = next((frame for frame in before if frame in lost), before[0])
    return Loss(first, unreliable[first])


@dataclass(frozen=True, eq=False)
class SeparatePart:
    """A part of the map whose pose relative to the main part is unknown.

    Attributes:
        submaps: numbers of its submaps. Its frame is that of the first one.
        frames: its frames with a pose.
        loss: why it is separate: where the camera was lost; None if that is not known.
        map: the fused map of its submaps; None before `finish`, and if no submap is readable.
    """

    submaps: tuple[int, ...]
    frames: TrackedFrames
    loss: Loss | None
    map: FusedMap | None = field(repr=False)


def separate_parts(
    parts: Sequence[tuple[int, ...]],
    frames: Sequence[TrackedFrames],
    maps: Sequence[FusedMap | None],
    path: CameraPath,
) -> list[SeparatePart]:
    """Describe all parts of a map but the main part, as far as frames were tracked in them.

    Args:
        parts, frames: submap numbers and frames of each part, the main part first.
        maps: fused map of each part; empty before the end of the run.
        path: all frames of the run.
    """
    starts = sorted(own.indices[0] for own in frames if own.indices)
    found = []
    for k, (part, own) in enumerate(zip(parts, frames, strict=True)):
        if k > 0 and own.indices:
            # The part that the run starts with ends where the next one starts.
            start = max([own.indices[0], *starts[1:2]])
            loss = loss_before(start, path.lost_frames, path.doubtful_frames)
            found.append(SeparatePart(part, own, loss, maps[k] if maps else None))
    return found


@dataclass(frozen=True, eq=False)
class SlamResult:
    """The state of a run; final once it was returned by `Slam.finish`.

    Where relocalisation of a lost camera has failed and no loop was found since, the map consists
    of parts with unknown relative poses. Trajectory and map are those of the main part.

    Attributes:
        trajectory: poses of the M tracked frames of the main part in the world, the frame of the
            part's first submap.
        frame_indices: [M] indices of these frames, in order.
        exposures: [M] exposures of these frames against the map; before `finish`, against the
            frame's submap.
        lost_frames: reason by index of the frames without a pose, in order.
        doubtful_frames: reason by index of the frames whose pose may be wrong, in order. They did
            not extend the map.
        keyframe_steps: number of optimisation steps by index of the keyframes that took any.
        frame_submaps: [M] number of the submap of each of the M frames.
        parts: numbers of the submaps of each part of the map, the main part first: that of the
            loaded map if a frame was located there, otherwise the part of the most frames.
        other_parts: the other parts, as far as frames were tracked in them.
        units_per_metre: of the unit of length in which the system worked; see `LengthUnit`.
        heard: what each listener has found, by its name.
        keyframe_indices: frame indices of all keyframes of this sequence, in order. A keyframe on
            the boundary of two submaps counts once; those of a loaded map do not count.
        submaps: all submaps by number.
        allocation: the decisions whether a keyframe starts a submap.
        loops: the accepted loop edges between submaps.
        map: the fused map of the main part; before `finish`, the active submap.
        semantics: decodes the features of the map; without channels for a map without semantics.
        taxonomy: the classes of the map, None for a map without semantics.
        covariances: [M, 6, 6] of x in T_world_camera exp(x), x = (translation m, rotation rad);
            None before `finish` and without loop closure.
        label_agreement: of the labels of keyframes with the map; without comparisons before
            `finish`, and without semantics.
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
    keyframe_steps: dict[int, int] = field(default_factory=dict)
    frame_submaps: list[int] = field(default_factory=list)
    parts: list[tuple[int, ...]] = field(default_factory=list)
    other_parts: list[SeparatePart] = field(default_factory=list)
    units_per_metre: float = 1.0
    heard: Mapping[str, Any] = field(default_factory=dict, repr=False)
    label_agreement: LabelAgreement = field(default_factory=LabelAgreement)

    @property
    def gaussians(self) -> GaussianCloud:
        """All Gaussians of the map, in memory."""
        return self.map.gaussians
