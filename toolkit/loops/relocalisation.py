"""Where a lost camera is: the keyframes it looks like, and alignment to their submap."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.matching import measure_offset
from toolkit.alignment.options import MatchingOptions
from toolkit.errors import ToolkitError
from toolkit.frame import Frame
from toolkit.keyframe import Keyframe
from toolkit.loops.candidates import Sighting
from toolkit.loops.detection import LoopDetector
from toolkit.loops.options import RelocalisationOptions
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.submap import Submap
from toolkit.tracking.health import has_depth
from toolkit.tracking.result import TrackingResult
from toolkit.tracking.tracker import LocatingTracker

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Found:
    """Where a frame was found.

    Attributes:
        submap: number of the submap.
        result: the tracker's answer in that submap's frame.
    """

    submap: int
    result: TrackingResult

    @property
    def T_submap_camera(self) -> NDArray[np.float64]:
        """[4, 4] pose of the camera."""
        return self.result.T_map_camera


@dataclass(frozen=True, eq=False)
class LastSeen:
    """When the camera was last placed, and where: [3] in the world, m."""

    timestamp_s: float
    position: NDArray[np.float64]


# Of so many times the keyframes to be tried, those in reach are looked for.
_POOL = 4


class Relocaliser:
    """Looks for lost frames among all keyframes."""

    def __init__(
        self,
        detector: LoopDetector,
        matching: MatchingOptions,
        options: RelocalisationOptions | None = None,
    ) -> None:
        self.options = options or RelocalisationOptions()
        self._detector, self._matching = detector, matching

    def find(
        self,
        frame: Frame,
        atlas: Atlas,
        tracker: LocatingTracker,
        last: LastSeen | None = None,
        anywhere: bool = True,
    ) -> Found | None:
        """The first place, of those that look alike, where the frame fits a submap.

        Args:
            last: where the camera was before, None if nobody knows.
            anywhere: False leaves out what is not in reach from there.
        """
        if not has_depth(frame):
            return None
        for sighting in self._alike(frame, atlas, last, anywhere):
            try:
                submap = atlas.submap(sighting.submap)
            except ToolkitError as error:
                # A submap whose file is lost cannot be where the camera is.
                _log.debug("frame %d: %s", frame.index, error)
                continue
            for keyframe in submap.keyframes:
                if keyframe.index == sighting.frame:
                    found = self._tried(frame, keyframe, submap, tracker)
                    if found is not None:
                        return found
        return None

    def _alike(
        self, frame: Frame, atlas: Atlas, last: LastSeen | None, anywhere: bool
    ) -> list[Sighting]:
        """Keyframes that look like a frame: first those in reach, then the most alike."""
        options, view = self.options, Keyframe.from_frame(frame, np.eye(4))
        if last is None:
            return self._detector.alike(view, options.tries)
        reach_m = options.slack_m + options.speed_m_s * abs(frame.timestamp_s - last.timestamp_s)
        found = self._detector.alike(view, _POOL * options.tries)
        near = [s for s in found if _apart_m(s, atlas, last) <= reach_m][: options.tries]
        return near + [s for s in found[: options.tries] if anywhere and s not in near]

    def _tried(
        self, frame: Frame, keyframe: Keyframe, submap: Submap, tracker: LocatingTracker
    ) -> Found | None:
        """The frame in a submap, from what its image and a keyframe's have in common."""
        offset = measure_offset(keyframe, Keyframe.from_frame(frame, np.eye(4)), self._matching)
        if offset is None:
            return None
        start = keyframe.T_map_camera @ offset.T_first_second
        result = tracker.locate(frame, submap.gaussians, start)
        if result.lost or result.visible_fraction < self.options.min_visible:
            return None
        if result.intensity_residual > self.options.max_intensity_residual:
            return None
        return Found(submap.number, result)


def _apart_m(sighting: Sighting, atlas: Atlas, last: LastSeen) -> float:
    """How far a keyframe lies from where the camera was."""
    T_submap_keyframe = atlas.keyframe_poses(sighting.submap).get(sighting.frame)
    if T_submap_keyframe is None:
        return float("inf")
    T_world_keyframe = atlas.T_world_submap(sighting.submap) @ T_submap_keyframe
    return float(np.linalg.norm(T_world_keyframe[:3, 3] - last.position))
