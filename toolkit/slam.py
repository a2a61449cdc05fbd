"""The method on one page: track each frame, map the keyframes, join submaps, refine at the end."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.camera_path import CameraPath
from toolkit.closing.closer import LoopCloser
from toolkit.exposure import Exposure
from toolkit.frame import Frame, NullRecorder, Recorder
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.trajectory import Trajectory
from toolkit.io.arrays import arrays_below
from toolkit.keyframe import Keyframe
from toolkit.loops.relocalisation import Found
from toolkit.mapping.mapper import Mapper, MappingResult
from toolkit.pose_graph.graph import PoseEdge
from toolkit.refinement.fusion import FusedMap, fuse
from toolkit.refinement.within import refine_submaps
from toolkit.registration.placement import KeyframePlacement
from toolkit.semantics.labeller import Labeller
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.submap import Submap
from toolkit.tracking.depth_filter import DepthFilter
from toolkit.tracking.health import shows_something
from toolkit.tracking.result import TrackingResult, exposure_of, not_tracked
from toolkit.tracking.tracker import LocatingTracker, Tracker

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameResult:
    """What became of one frame.

    Attributes:
        index: the frame's index in its sequence.
        T_map_camera: [4, 4] float64 pose in the frame of the active submap, or None if the
            frame is lost.
        tracking: the tracker's result; None for the frame that started the map. It is lost for
            a frame that nothing located and that started a submap of unknown position.
        mapping: what mapping did; None unless the frame became a keyframe.
        T_world_camera: the same pose in the world, as it is known by now: loops move it.
    """

    index: int
    T_map_camera: NDArray[np.float64] | None
    tracking: TrackingResult | None
    mapping: MappingResult | None
    T_world_camera: NDArray[np.float64] | None = None

    @property
    def lost(self) -> bool:
        """Whether the frame has no pose."""
        return self.T_map_camera is None


class Slam:
    """RGB-D Gaussian SLAM: feed it frames in order, then call `finish`."""

    def __init__(  # noqa: PLR0913 - here all parts meet
        self,
        tracker: Tracker,
        mapper: Mapper,
        recorder: Recorder | None = None,
        labeller: Labeller | None = None,
        atlas: Atlas | None = None,
        closer: LoopCloser | None = None,
        denoise: bool = True,
        placement: KeyframePlacement | None = None,
    ) -> None:
        """Put the parts together.

        Args:
            closer: corrects drift, and finds the camera again when it is lost.
            denoise: smooth each frame's depth as much as its noise asks for.
            placement: corrects the poses of keyframes by what earlier ones observed.
        """
        self.tracker = tracker
        self.mapper = mapper
        self.atlas = Atlas(mapper) if atlas is None else atlas
        self.fused: FusedMap | None = None
        self._labeller = labeller
        self._closer = closer
        self._placement = placement
        self._filter = DepthFilter() if denoise else None
        self._recorder = recorder or NullRecorder()
        self._path = CameraPath()
        self.lost_frames: list[int] = []
        self._lost_in_a_row = 0

    def begin_in(self, submaps: Iterable[Submap]) -> None:
        """Begin in the map of an earlier run, before the first frame.

        Each frame is lost until one is found there; after the patience of relocalisation a
        submap begins that a loop may join later. The world is the earlier run's.

        Args:
            submaps: as `Atlas.begin_in` takes them, with descriptors of this run's kind.

        Raises:
            ValueError: nothing here can look for a camera.
        """
        if self._closer is None or not isinstance(self.tracker, LocatingTracker):
            raise ValueError("a saved map needs loop closure, and a tracker that can locate")
        self.atlas.begin_in(submaps)
        self._closer.begin_in(self.atlas)

    def prepare(self, frame: Frame) -> None:
        """Do ahead of a frame's turn what needs no map; results are the same without.

        Another thread may call this while earlier frames are processed (`prefetched`).
        """
        if self.mapper.device.type == "cpu":
            return  # tracking and mapping want all cores for themselves
        if self._filter is not None:
            frame = self._filter.prepare(frame)
        self.tracker.prepare(frame, self.mapper.device)

    def process_frame(self, frame: Frame, may_map: bool = True) -> FrameResult:
        """Track one frame and, where it adds something, map it.

        Args:
            may_map: False keeps the frame out of the map (a held-out view).
        """
        tracking = None
        if self._filter is not None:
            with self._recorder.timed("denoising"):
                frame = self._filter.of(frame)
        if self._labels_first:
            frame = self._labelled(frame, None)
        if not self.atlas.begun:
            lost = not_tracked("it is not found in the saved map")
            T_map_camera, tracking = self._recovered(frame, lost, may_map)
        elif not self.mapper.keyframes:
            T_map_camera = self.tracker.first_pose(frame) if may_map else None
        else:
            with self._recorder.timed("tracking"):
                tracking = self.tracker.track(frame, self.mapper.gaussians)
            T_map_camera = tracking.T_map_camera
            if tracking.lost:
                T_map_camera, tracking = self._recovered(frame, tracking, may_map)
        if T_map_camera is None:
            self.lost_frames.append(frame.index)
            self._lost_in_a_row += shows_something(frame)
            return FrameResult(frame.index, None, tracking, None)

        self._lost_in_a_row = 0
        mapping = None
        if may_map and self.mapper.wants(frame, T_map_camera):
            if self._labeller is not None and not self._labels_first:
                frame = self._labelled(frame, T_map_camera)
            keyframe = Keyframe.from_frame(frame, T_map_camera, exposure_of(tracking))
            self._place(keyframe)
            with self._recorder.timed("mapping"):
                mapping = self.mapper.add_keyframe(keyframe)
            if self._closer is not None:
                self._closer.observe(self.atlas)
            T_map_camera = self._allocate(tracking)

        self._path.add(frame, self.atlas, T_map_camera, tracking)
        T_world_camera = self.atlas.T_world_submap(self.atlas.active) @ T_map_camera
        return FrameResult(frame.index, T_map_camera, tracking, mapping, T_world_camera)

    def _recovered(
        self, frame: Frame, lost: TrackingResult, may_map: bool
    ) -> tuple[NDArray[np.float64] | None, TrackingResult]:
        """Relocalise a lost frame.

        If it is found in the active submap, tracking continues there. If it is found in another
        submap, or `patience` frames were lost in a row, a new submap starts at the frame. Frames
        without depth are not counted.

        Returns:
            T_map_camera [4, 4] in the active submap, None if the frame stays lost; and the
            result of relocalisation, or `lost` where nothing located the frame.
        """
        tracker = self.tracker
        if self._closer is None or not isinstance(tracker, LocatingTracker):
            return None, lost
        if not shows_something(frame):
            return None, lost
        relocaliser = self._closer.relocaliser
        at_an_end = self._lost_in_a_row >= relocaliser.options.patience
        with self._recorder.timed("relocalisation"):
            last = self._path.last_seen(self.atlas)
            found = relocaliser.find(frame, self.atlas, tracker, last, anywhere=at_an_end)
        if found is not None and self.atlas.begun and found.submap == self.atlas.active:
            tracker.go_on_from(frame.timestamp_s, found.T_submap_camera)
            _log.info("frame %d is found again in submap %d", frame.index, found.submap)
            return found.T_submap_camera, found.result
        if not may_map:
            return None, lost
        if found is not None:
            self._begin_at(frame, found)
            tracker.go_on_from(frame.timestamp_s, np.eye(4))
            return np.eye(4), replace(found.result, T_map_camera=np.eye(4))
        if not at_an_end or tracker.first_pose(frame) is None:
            return None, lost
        self._begin_at(frame, None)
        tracker.go_on_from(frame.timestamp_s, np.eye(4))
        return np.eye(4), lost

    def _begin_at(self, frame: Frame, found: Found | None) -> None:
        """Begin a submap at a frame, joined to where it was found or to nothing yet."""
        assert self._closer is not None
        atlas = self.atlas
        if self._labeller is not None and not self._labels_first:
            frame = self._labelled(frame, None)
        self._close_within()
        with self._recorder.timed("mapping"):
            if found is None:
                anchor = Keyframe.from_frame(frame, np.eye(4))
                atlas.begin_at(anchor, *self._path.last_place(atlas), inherit=False)
            else:
                anchor = Keyframe.from_frame(frame, np.eye(4), found.result.exposure)
                atlas.begin_at(anchor, found.submap, found.T_submap_camera)
        self._closer.join(atlas, found)
        self._closer.close_between(atlas, atlas.active - 1)
        self._closer.observe(atlas)
        _log.warning(
            "submap %d begins at frame %d, %s",
            atlas.active,
            frame.index,
            f"found in submap {found.submap}"
            if found
            else "joined to nothing until a loop is found",
        )

    def _place(self, keyframe: Keyframe) -> None:
        """Refine the pose of a new keyframe against earlier ones; the tracker continues there."""
        if self._placement is None or not self.mapper.keyframes:
            return
        T_tracked = keyframe.T_map_camera
        with self._recorder.timed("placing"):
            keyframe.T_map_camera = self._placement.place(self.mapper.keyframes, keyframe)
        self.tracker.change_frame(keyframe.T_map_camera @ se3.inverse(T_tracked))

    def _allocate(self, tracking: TrackingResult | None) -> NDArray[np.float64]:
        """Start the next submap if it is due; the newest keyframe's pose in the active submap."""
        verdict = self.atlas.judge()
        if verdict is not None and verdict.begins:
            self._close_within()
            with self._recorder.timed("mapping"):
                self.tracker.change_frame(self.atlas.begin_next())
            _log.info(
                "Started submap %d at frame %d: %s",
                self.atlas.active,
                verdict.index,
                verdict.reason,
            )
            if self._closer is not None:
                information = np.zeros((6, 6)) if tracking is None else tracking.information
                self._closer.link(self.atlas, information)
                self._closer.close_between(self.atlas, self.atlas.active - 1)
        return self.mapper.keyframes[-1].T_map_camera

    def _close_within(self) -> None:
        """Close the active submap's own loops; the tracker follows its newest keyframe."""
        if self._closer is None or not self.mapper.keyframes:
            return
        before = self.mapper.keyframes[-1].T_map_camera
        if self._closer.close_within(self.atlas):
            after = self.mapper.keyframes[-1].T_map_camera
            self.tracker.change_frame(after @ se3.inverse(before))

    @property
    def _labels_first(self) -> bool:
        """Whether frames are labelled before they are tracked, not only as keyframes."""
        labeller = self._labeller
        return labeller is not None and (labeller.every_frame or self.tracker.wants_labels)

    def _labelled(self, frame: Frame, T_map_camera: NDArray[np.float64] | None) -> Frame:
        assert self._labeller is not None
        # Segmenters know one world, whichever submap is active.
        T_world_map = self.atlas.T_world_submap(self.atlas.active)
        T_world_camera = None if T_map_camera is None else T_world_map @ T_map_camera
        with self._recorder.timed("labelling"):
            return self._labeller.label(frame, T_world_camera)

    def finish(self) -> None:
        """Refine every submap over its keyframes and join them; nothing without a map."""
        if not self.mapper.keyframes:
            return
        self._close_within()
        if self._closer is not None:
            self._closer.close_between(self.atlas, self.atlas.active)
        with self._recorder.timed("refinement"):
            # Views of a refined map are no longer where frames and other submaps see them.
            if self._closer is not None:
                self._closer.settle(self.atlas)
            refine_submaps(self.atlas)
            self.fused = fuse(self.atlas)

    @property
    def gaussians(self) -> GaussianCloud:
        """The whole map in the world's frame, once finished; until then the active submap."""
        return self.mapper.content.gaussians if self.fused is None else self.fused.gaussians

    @property
    def keyframe_indices(self) -> list[int]:
        """Frame indices of all keyframes, in order; one on a boundary counts once.

        Those of a saved map are no frames of this sequence.
        """
        atlas = self.atlas
        return sorted({i for n in range(atlas.saved, len(atlas)) for i in atlas.keyframe_poses(n)})

    @property
    def keyframe_count(self) -> int:
        """How many keyframes there are."""
        return len(self.keyframe_indices)

    @property
    def loops(self) -> list[PoseEdge]:
        """The loop edges between submaps that are held now."""
        return [] if self._closer is None else list(self._closer.loops)

    @property
    def taxonomy(self) -> Taxonomy | None:
        """The classes that the map knows, None for a map without semantics."""
        return None if self._labeller is None else self._labeller.taxonomy

    @property
    def tracked_indices(self) -> list[int]:
        """Indices of the frames that have a pose, in order."""
        return self._path.indices

    @property
    def exposures(self) -> list[Exposure]:
        """Exposure of each tracked frame against its submap; once finished, against the map."""
        return self._path.exposures({} if self.fused is None else self.fused.exposures)

    @property
    def trajectory(self) -> Trajectory:
        """Poses of the tracked frames in the world, the first submap's frame."""
        return self._path.trajectory(self.atlas)

    @property
    def covariances(self) -> NDArray[np.float64] | None:
        """[M, 6, 6] of x in T_world_camera exp(x) of the tracked frames; None without loops."""
        if self._closer is None:
            return None
        places = self._path.poses_in_submaps(self.atlas)
        return self._closer.covariances(self.atlas, self._path.submaps, places)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues to identical results."""
        arrays, values = self.mapper.state()
        arrays = {f"mapper/{k}": a for k, a in arrays.items()}
        arrays |= {f"tracker/{k}": a for k, a in self.tracker.state().items()}
        if self._labeller is not None:
            arrays |= {f"segmenter/{k}": a for k, a in self._labeller.segmenter.state().items()}
        atlas_arrays, atlas_values = self.atlas.state()
        arrays |= {f"atlas/{k}": a for k, a in atlas_arrays.items()}
        closer_values = None
        if self._closer is not None:
            closer_arrays, closer_values = self._closer.state()
            arrays |= {f"closer/{k}": a for k, a in closer_arrays.items()}
        arrays["T_keyframe_camera"], tracked = self._path.state()
        return arrays, {
            "mapper": values,
            "atlas": atlas_values,
            "closer": closer_values,
            "tracked": tracked,
            "lost_frames": self.lost_frames,
            "lost_in_a_row": self._lost_in_a_row,
        }

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Take over an earlier `state`."""

        self.mapper.restore(arrays_below(arrays, "mapper/"), values["mapper"])
        self.atlas.restore(arrays_below(arrays, "atlas/"), values["atlas"])
        if self._closer is not None:
            self._closer.restore(arrays_below(arrays, "closer/"), values["closer"])
        self.tracker.restore(arrays_below(arrays, "tracker/"))
        if self._labeller is not None:
            self._labeller.segmenter.restore(arrays_below(arrays, "segmenter/"))
        self._path.restore(arrays["T_keyframe_camera"], values["tracked"])
        self.lost_frames = [int(i) for i in values["lost_frames"]]
        self._lost_in_a_row = int(values["lost_in_a_row"])
