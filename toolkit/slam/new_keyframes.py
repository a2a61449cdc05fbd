"""New keyframes: which frames become one, their final pose, and the map that they extend."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame, Recorder
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.base.stages import Stage
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.intermediate_mapping import IntermediateMapping
from toolkit.slam.mapping.mapper import Mapper, MappingResult
from toolkit.slam.submap_changes import SubmapChanges
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.evidence import shows_much_unmapped
from toolkit.slam.tracking.health import has_depth
from toolkit.slam.tracking.result import TrackingResult, exposure_of


class NewKeyframes:
    """Adds keyframes to the active submap.

    Args:
        changes: know whether a frame shows a surface.
        between: map the frames between two keyframes.
    """

    def __init__(
        self,
        front_end: FrontEnd,
        mapper: Mapper,
        atlas: Atlas,
        changes: SubmapChanges,
        between: IntermediateMapping,
        recorder: Recorder,
    ) -> None:
        self._front_end, self._mapper, self._atlas = front_end, mapper, atlas
        self._changes, self._between, self._recorder = changes, between, recorder

    def wants(
        self, frame: Frame, T_map_camera: NDArray[np.float64], tracking: TrackingResult | None
    ) -> bool:
        """Whether the active submap should have a frame as a keyframe."""
        keyframes, visited = self._atlas.keyframes, self._atlas.visited
        unmapped = shows_much_unmapped(tracking) and has_depth(frame)
        unmapped = unmapped and bool(keyframes) and keyframes[-1].index < frame.index
        if not (unmapped or self._mapper.wants(keyframes, frame, T_map_camera, visited)):
            return False
        return not self._changes.shows_surface(keyframes, frame, T_map_camera)

    def add(
        self, frame: Frame, T_map_camera: NDArray[np.float64], tracking: TrackingResult | None
    ) -> MappingResult:
        """Create a keyframe, refine its pose, and extend the map with it."""
        exposure = exposure_of(tracking)
        if self._atlas.keyframes:
            # Until the mapper estimates that of the new keyframe.
            exposure = exposure.with_balance(self._atlas.keyframes[-1].exposure.balance)
        keyframe = Keyframe.from_frame(frame, T_map_camera, exposure)
        if self._front_end.correction is not None:
            keyframe.prior_m = keyframe.depth_m
        self._refine_pose(keyframe, tracking)
        if self._atlas.keyframes:
            self._between.select(keyframe)
        with self._recorder.timed(Stage.MAPPING):
            mapping = self._mapper.add_keyframe(self._atlas.current, keyframe)
        if self._mapper.deferred is None:
            self._between.map_all()
        self._front_end.closer.keyframe_added(self._atlas)
        return mapping

    def _refine_pose(self, keyframe: Keyframe, tracking: TrackingResult | None) -> None:
        """Refine the pose of a new keyframe; the tracker continues from the refined pose."""
        placement = self._front_end.placement
        if placement is None or not self._atlas.keyframes:
            return
        T_tracked = keyframe.T_map_camera
        with self._recorder.timed(Stage.PLACING):
            keyframe.T_map_camera = placement.place(
                self._atlas.keyframes,
                keyframe,
                None if tracking is None else tracking.T_by_features,
            )
        self._front_end.tracker.correct(keyframe.T_map_camera @ se3.inverse(T_tracked))
