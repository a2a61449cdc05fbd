"""The SLAM pipeline: track each frame, map keyframes, close loops, and refine at the end."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

from numpy.typing import NDArray

from toolkit.base.frame import Frame, FrameStamp, NullRecorder, Recorder
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.base.stages import Stage
from toolkit.base.threads import single_threaded_blas
from toolkit.io.arrays import arrays_below
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.camera_path import CameraPath, fingerprint
from toolkit.slam.carrier_watch import CarrierWatch
from toolkit.slam.collection import collected, parts_of, poses_beside
from toolkit.slam.frame_locator import FrameLocator
from toolkit.slam.frame_preparation import FramePreparation, FrameSources
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.intermediate_mapping import IntermediateMapping
from toolkit.slam.length_unit import METRE, LengthUnit
from toolkit.slam.listeners import MapListener
from toolkit.slam.mapping.deferred import DeferredSteps
from toolkit.slam.mapping.intermediate_frames import IntermediateFrames
from toolkit.slam.mapping.keyframes import KeyframeChoice
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.new_keyframes import NewKeyframes
from toolkit.slam.recovery import Recovery
from toolkit.slam.refinement.anchors import align_anchors
from toolkit.slam.refinement.fusion import FusedMap, fuse
from toolkit.slam.refinement.parts import separate
from toolkit.slam.refinement.saved_labels import label_saved
from toolkit.slam.refinement.within import StepProgress, refine_submaps
from toolkit.slam.result import FrameResult, SlamResult
from toolkit.slam.submap_changes import SubmapChanges
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.tracking.health import is_blank
from toolkit.slam.tracking.moving import MovingTracker
from toolkit.slam.tracking.result import at_pose_of_last, exposure_of, not_tracked
from toolkit.slam.tracking.tracker import LocatingTracker

_log = logging.getLogger(__name__)


class _Part(Protocol):
    """A component whose state consists of arrays and JSON values."""

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]: ...

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None: ...


class Slam:
    """RGB-D Gaussian SLAM: call `process_frame` for each frame in order, then `finish`.

    Attributes:
        up_side: the side of the images that is up, for viewers.
    """

    up_side: ImageSide = "top"

    def __init__(
        self,
        front_end: FrontEnd,
        mapper: Mapper,
        atlas: Atlas | None = None,
        sources: FrameSources | None = None,
        recorder: Recorder | None = None,
        listeners: Sequence[MapListener] = (),
    ) -> None:
        """Assemble the system.

        Args:
            front_end: finds the poses of frames.
            mapper: extends and optimises submaps.
            atlas: holds all submaps; a single submap by default.
            sources: what frames are prepared with; by default, they are denoised.
            recorder: receives times and counts.
            listeners: are told how the map grows, in this order.
        """
        self.mapper = mapper
        self.tracker = front_end.tracker
        self.atlas = Atlas(mapper.first_submap()) if atlas is None else atlas
        self._recorder = recorder or NullRecorder()
        self._closer = front_end.closer
        self._unit = front_end.unit
        self._path = CameraPath()
        sources = sources or FrameSources()
        self._carrier = CarrierWatch() if sources.watches_carrier else None
        self._preparation = FramePreparation(
            sources, front_end, mapper, self.atlas, self._path, self._recorder
        )
        options, measured = mapper.options, self._preparation.correction is None
        views = options.final_views if options.final_iterations else 0
        label = self._preparation.labelled
        self._between = IntermediateMapping(
            IntermediateFrames(options.fill_holes, views, measured),
            mapper,
            self.atlas,
            label,
            self._recorder,
        )
        self._recovery = Recovery(front_end, mapper, self.atlas, self._path, label, self._recorder)
        self._locator = FrameLocator(front_end, self.atlas, self._recovery, self._recorder)
        self._changes = SubmapChanges(front_end, mapper, self.atlas, self._recorder)
        self._keyframes = NewKeyframes(
            front_end, mapper, self.atlas, self._changes, self._between, self._recorder
        )
        self._fused: list[FusedMap | None] = []
        self._listeners = listeners

    @property
    def unit(self) -> LengthUnit:
        """The unit of length in which the parts of the system work."""
        return METRE if self._unit is None else self._unit

    @property
    def loops(self) -> Sequence[PoseEdge]:
        """The accepted loop edges between submaps so far."""
        return self._closer.loops

    @property
    def parts(self) -> list[tuple[int, ...]]:
        """Parts of the map so far: numbers of submaps with known relative poses, as in results."""
        return parts_of(self.atlas, self._path, self._closer)

    @property
    def camera_path(self) -> CameraPath:
        """The poses of the frames so far, relative to keyframes."""
        return self._path

    def load_map(self, submaps: Iterable[Submap]) -> None:
        """Load the map of an earlier run, before the first frame; it is extended but not changed.

        The world frame is that of the earlier run. Frames are lost until one is relocalised in the
        loaded map, or until relocalisation has failed for `patience` frames and a new submap
        starts.

        Args:
            submaps: as in `Atlas.load_map`, with descriptors of the same encoder as in this run.

        Raises:
            ValueError: loop closure is disabled, or the tracker cannot locate frames.
        """
        if self._closer.relocaliser is None or not isinstance(self.tracker, LocatingTracker):
            raise ValueError("loading a map requires loop closure and a tracker that can locate")
        self._unit = self.unit  # later frames must not choose another one
        self.atlas.load_map(map(self.unit.submap, submaps))
        self._closer.map_loaded(self.atlas)

    def listener(self, name: str) -> MapListener | None:
        """The listener of a name; None without it."""
        return next((one for one in self._listeners if one.name == name), None)

    def prepare(self, frame: Frame) -> None:
        """Do work for a later frame that does not depend on the map; results do not change.

        Another thread may call this while earlier frames are processed (`prefetched`).
        """
        if self.mapper.device.type == "cpu" or frame.readout_s > 0.0 or not self.unit.is_metre:
            return  # tracking and mapping need all cores; rectification, the frames before
        self.tracker.prepare(self._preparation.ahead(frame), self.mapper.device)

    @single_threaded_blas()
    def process_frame(self, frame: Frame, may_map: bool = True) -> FrameResult:
        """Track one frame, and map it if it becomes a keyframe.

        Args:
            frame: the next frame of the sequence.
            may_map: False for a held-out view, which does not change the map.

        Returns:
            The pose of the frame; without one if its files could not be read, or its time is not
            after that of the frame before.
        """
        if self._unit is None:
            self._unit = LengthUnit.of_frame(frame)
        return self.unit.frame_result_in_metres(self._processed(self.unit.frame(frame), may_map))

    def _processed(self, frame: Frame, may_map: bool) -> FrameResult:
        """Track and map a frame, in the unit of the system."""
        recorded = fingerprint(frame)
        known = self._known(frame, recorded)
        if known is not None:
            return known
        if self._carrier is not None:
            submap = self.atlas.current if self.atlas.has_active_submap else None
            frame = self._carrier.of(frame, submap)
        observed, frame = frame, self._preparation.before_tracking(frame)
        located = self._locator.locate(frame, may_map)
        T_map_camera, tracking = located.T_map_camera, located.tracking
        if T_map_camera is None:
            lost = tracking or not_tracked("")
            self._path.add_lost(frame, lost.reason, ambiguous=lost.ambiguous)
            return FrameResult(frame.index, None, tracking)

        mapping = None
        may_map &= not located.doubtful and not is_blank(frame)
        if may_map:
            frame = self._preparation.for_mapping(frame, T_map_camera)
        if may_map and self._keyframes.wants(frame, T_map_camera, tracking):
            again = self._changes.seen_again(frame, T_map_camera, tracking)
            if again is None:
                frame = self._preparation.as_keyframe(observed, frame, T_map_camera)
                mapping = self._keyframes.add(frame, T_map_camera, tracking)
                self._changes.start_if_due(tracking)
                T_map_camera = self.atlas.keyframes[-1].T_map_camera
            elif again.found is not None:
                self._between.select()
                if self.mapper.deferred is None:
                    self._between.map_all()
                self._changes.enter(again.found, frame, T_map_camera)
                T_map_camera, tracking = again.found.T_submap_camera, again.found.result
        elif may_map:
            self._between.add(frame, T_map_camera, exposure_of(tracking))

        for listener in self._listeners:
            listener.frame_added(self.atlas, 1.0 / self.unit.per_metre)
        steps = 0 if mapping is None else mapping.steps
        self._path.add(frame, self.atlas, T_map_camera, tracking, steps, recorded)
        T_world_camera = self.atlas.T_world_submap(self.atlas.active) @ T_map_camera
        is_keyframe = self.atlas.keyframes[-1].index == frame.index
        return FrameResult(
            frame.index,
            T_map_camera,
            tracking,
            mapping,
            T_world_camera,
            is_keyframe,
            submap=self.atlas.active,
        )

    def _known(self, frame: Frame, recorded: int) -> FrameResult | None:
        """The result of a frame that need not be tracked: an unusable one, or the last one again.

        Where poses are given, equal images do not matter.

        Args:
            recorded: fingerprint of its images.
        """
        if unusable := frame.fault or self._path.disorder(frame):
            self._path.add_lost(frame, unusable, tried=False)
            return FrameResult(frame.index, None, not_tracked(unusable))
        if isinstance(self.tracker, MovingTracker) and self._path.repeats(recorded):
            return self._like_last(frame, self._path.add_repeated(frame, self.atlas))
        return None

    def drop_frame(self, frame: FrameStamp) -> FrameResult:
        """Record a frame without processing it; its pose is that of the frame before.

        While the camera is lost, the frame is lost as well.
        """
        if not self._path.add_dropped(frame):
            return FrameResult(frame.index, None, None, dropped=True)
        result = replace(self._like_last(frame), tracking=None, dropped=True)
        return self.unit.frame_result_in_metres(result)

    def _like_last(self, frame: FrameStamp, doubt: str = "") -> FrameResult:
        """The result of a frame at the pose of the frame before, and why that may be wrong."""
        number, T_map_camera = self._path.last_pose(self.atlas)
        T_world_camera = self.atlas.T_world_submap(number) @ T_map_camera
        return FrameResult(
            frame.index,
            T_map_camera,
            at_pose_of_last(T_map_camera, doubt),
            T_world_camera=T_world_camera,
            submap=number,
        )

    def defer_work(self, keyframes: KeyframeChoice) -> DeferredSteps:
        """Defer work that poses do not depend on.

        Most optimisation steps are taken by `take_deferred_step`, intermediate frames are mapped
        by `map_intermediate_frame`, and loops between submaps are closed by `finish`.

        Args:
            keyframes: decides which tracked frames become keyframes from now on.

        Returns:
            The deferred steps.
        """
        self._closer.defer()
        return self.mapper.defer_steps(keyframes)

    @single_threaded_blas()
    def take_deferred_step(self) -> None:
        """Take one of the deferred optimisation steps, if there are any."""
        with self._recorder.timed(Stage.MAPPING):
            self.mapper.take_deferred_step(self.atlas.current)

    @single_threaded_blas()
    def map_intermediate_frame(self) -> bool:
        """Map the first intermediate frame that waits; return False if none does."""
        return self._between.map_next()

    @single_threaded_blas()
    def finish(self, progress: StepProgress = iter) -> SlamResult:
        """Close the remaining loops, refine every submap over its keyframes, and fuse each part.

        Args:
            progress: wraps the numbers of the refinement's steps, for instance in a progress bar.
        """
        if self.atlas.keyframes:
            self._between.select()
            self._between.map_all()
            with self._recorder.timed(Stage.REFINEMENT):
                self._closer.finish(self.atlas, self.mapper)
                parts = self.parts
                separate(self.atlas, parts)
                poses = partial(poses_beside, self.atlas, self._path, parts)
                refine_submaps(self.atlas, self.mapper, poses, progress)
                if self.mapper.options.final_anchors:
                    align_anchors(self.atlas, self.mapper, parts)
                label_saved(self.atlas, self.mapper, parts)
                free_space = self.mapper.options.free_space
                self._fused = [fuse(self.atlas, part, free_space) for part in parts]
                for listener in self._listeners:
                    listener.finished(self.atlas, 1.0 / self.unit.per_metre, self._fused)
        return self.result()

    @property
    def sources(self) -> FrameSources:
        """What frames are prepared with."""
        return self._preparation.sources

    @property
    def taxonomy(self) -> Taxonomy | None:
        """The classes of the map; None without semantics."""
        labeller = self._preparation.labeller
        return None if labeller is None else labeller.taxonomy

    def result(self) -> SlamResult:
        """The current state of the run."""
        semantics, maps = self.mapper.semantics, self._fused
        found = collected(self.atlas, self._path, self._closer, maps, semantics, self.taxonomy)
        heard = {one.name: one.content() for one in self._listeners}
        found = replace(found, label_agreement=self.mapper.label_agreement, heard=heard)
        return self.unit.result_in_metres(found)

    def store_in_metres(self) -> None:
        """Convert the stored submaps of a finished run; nothing may be processed afterwards."""
        if self.unit.is_metre:
            return
        for number in range(len(self.atlas)):
            if number not in self.atlas.unreadable:
                self.atlas.put(self.unit.submap_in_metres(self.atlas.submap(number)))

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues to identical results."""
        arrays = {f"tracker/{k}": a for k, a in self.tracker.state().items()}
        arrays |= {f"segmenter/{k}": a for k, a in self._preparation.state().items()}
        values: dict[str, Any] = {"units_per_metre": self._unit and self._unit.per_metre}
        values["up_side"] = self.up_side
        for name, part in self._parts().items():
            part_arrays, values[name] = part.state()
            arrays |= {f"{name}/{k}": a for k, a in part_arrays.items()}
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        if self._unit is None and values["units_per_metre"]:
            self._unit = LengthUnit(float(values["units_per_metre"]))
        for name, part in self._parts().items():
            part.restore(arrays_below(arrays, f"{name}/"), values[name])
        self.tracker.restore(arrays_below(arrays, "tracker/"))
        self._preparation.restore(arrays_below(arrays, "segmenter/"))

    def _parts(self) -> dict[str, _Part]:
        """The components with a state, in the order of restoring."""
        parts: dict[str, _Part] = {
            "mapper": self.mapper,
            "atlas": self.atlas,
            "closer": self._closer,
            "path": self._path,
            "between": self._between,
            "recovery": self._recovery,
            "changes": self._changes,
        }
        correction = self._preparation.correction
        parts |= {} if correction is None else {"correction": correction}
        parts |= {} if self._carrier is None else {"carrier": self._carrier}
        return parts | {listener.name: listener for listener in self._listeners}
