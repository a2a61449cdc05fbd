"""Maps what only frames between two keyframes show, and keeps some of them for the refinement."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame, Recorder
from toolkit.base.keyframe import Keyframe
from toolkit.base.stages import Stage
from toolkit.slam.mapping.intermediate_frames import MIN_OUTSIDE, IntermediateFrames
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas


class IntermediateMapping:
    """Extends the active submap with frames between its keyframes.

    Args:
        frames: the frames since the newest keyframe.
        mapper: extends submaps.
        atlas: holds the active submap.
        labelled: labels a frame at a pose.
        recorder: receives times.
    """

    def __init__(
        self,
        frames: IntermediateFrames,
        mapper: Mapper,
        atlas: Atlas,
        labelled: Callable[[Frame, NDArray[np.float64]], Frame],
        recorder: Recorder,
    ) -> None:
        self._frames, self._mapper, self._atlas = frames, mapper, atlas
        self._labelled, self._recorder = labelled, recorder

    def add(self, frame: Frame, T_map_camera: NDArray[np.float64], exposure: Exposure) -> None:
        """Add a tracked frame that does not become a keyframe."""
        self._frames.add(frame, self._atlas.keyframes[-1], T_map_camera, exposure)

    def select(self, newest: Keyframe | None = None) -> None:
        """Select from the frames between the last keyframe and a new one, or at the end."""
        last = self._atlas.keyframes[-1]
        self._atlas.current.views.extend(self._frames.select(last, newest))

    def map_all(self) -> None:
        """Map all selected frames."""
        while self.map_next():
            pass

    def map_next(self) -> bool:
        """Map the first selected frame; return False if there is none."""
        between = self._frames.take()
        if between is None:
            return False
        keyframes = self._atlas.current.keyframes_from(between.keyframe)
        if not keyframes:
            return True  # of another submap
        T_map_camera = keyframes[0].T_map_camera @ between.T_keyframe_camera
        densification, seen = self._mapper.densification, between.frame
        with self._recorder.timed(Stage.MAPPING):
            view = self._mapper.render(self._atlas.gaussians, seen.camera, T_map_camera)
            mask = densification.unmapped_pixels(view, seen, T_map_camera, keyframes)
        if mask.mean() >= MIN_OUTSIDE:
            frame = self._labelled(between.at_map_exposure(), T_map_camera)
            with self._recorder.timed(Stage.MAPPING):
                densification.seed_pixels(
                    self._atlas.current, frame, T_map_camera, mask, keyframes[0]
                )
        return True

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        return self._frames.state()

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self._frames.restore(arrays, values)
