"""Relocalisation of a lost camera: keyframe retrieval, then alignment to the submap."""

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
from toolkit.loops.candidates import SimilarKeyframe
from toolkit.loops.detection import LoopDetector
from toolkit.loops.options import RelocalisationOptions
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.submap import Submap
from toolkit.tracking.health import has_depth
from toolkit.tracking.result import Health, TrackingResult
from toolkit.tracking.tracker import LocatingTracker

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Relocalisation:
    """A successful relocalisation.

    Attributes:
        submap: number of the submap.
        result: tracking result in that submap's frame.
    """

    submap: int
    result: TrackingResult

    @property
    def T_submap_camera(self) -> NDArray[np.float64]:
        """[4, 4] pose of the camera."""
        return self.result.T_map_camera


@dataclass(frozen=True, eq=False)
class LastPosition:
    """Timestamp and position of the last tracked frame.

    Attributes:
        timestamp_s: seconds.
        position: [3] in the world frame, metres.
    """

    timestamp_s: float
    position: NDArray[np.float64]


# Retrieved keyframes per keyframe tried, before those out of reach are removed.
_POOL_FACTOR = 4


class Relocaliser:
    """Relocalises lost frames against the keyframes of all submaps."""

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
        last: LastPosition | None = None,
        anywhere: bool = True,
    ) -> Relocalisation | None:
        """Align the frame to the submaps of similar keyframes; returns the first success.

        Args:
            frame: lost frame.
            atlas: submaps to search.
            tracker: aligns the frame to a submap.
            last: last known position of the camera, None if unknown.
            anywhere: False restricts the search to keyframes in reach of that position.
        """
        if not has_depth(frame):
            return None
        for match in self._matches(frame, atlas, last, anywhere):
            try:
                submap = atlas.submap(match.submap)
            except ToolkitError as error:
                # Skip submaps whose file cannot be read.
                _log.debug("frame %d: %s", frame.index, error)
                continue
            for keyframe in submap.keyframes:
                if keyframe.index == match.frame:
                    found = self._align(frame, keyframe, submap, tracker)
                    if found is not None:
                        return found
        return None

    def _matches(
        self, frame: Frame, atlas: Atlas, last: LastPosition | None, anywhere: bool
    ) -> list[SimilarKeyframe]:
        """Keyframes similar to a frame: those in reach first, then the most similar ones."""
        options, view = self.options, Keyframe.from_frame(frame, np.eye(4))
        if last is None:
            return self._detector.most_similar(view, options.tries)
        reach_m = options.slack_m + options.speed_m_s * abs(frame.timestamp_s - last.timestamp_s)
        found = self._detector.most_similar(view, _POOL_FACTOR * options.tries)
        near = [s for s in found if _distance_m(s, atlas, last) <= reach_m][: options.tries]
        return near + [s for s in found[: options.tries] if anywhere and s not in near]

    def _align(
        self, frame: Frame, keyframe: Keyframe, submap: Submap, tracker: LocatingTracker
    ) -> Relocalisation | None:
        """Align a frame to a submap, starting from image matches with one of its keyframes."""
        offset = measure_offset(keyframe, Keyframe.from_frame(frame, np.eye(4)), self._matching)
        if offset is None:
            return None
        start = keyframe.T_map_camera @ offset.T_first_second
        result = tracker.locate(frame, submap.gaussians, start, search=False)
        if result.health is not Health.GOOD or result.visible_fraction < self.options.min_visible:
            return None
        if result.intensity_residual > self.options.max_intensity_residual:
            return None
        return Relocalisation(submap.number, result)


def _distance_m(match: SimilarKeyframe, atlas: Atlas, last: LastPosition) -> float:
    """Distance from the last camera position to a keyframe, metres; infinite if unknown."""
    T_submap_keyframe = atlas.keyframe_poses(match.submap).get(match.frame)
    if T_submap_keyframe is None:
        return float("inf")
    T_world_keyframe = atlas.T_world_submap(match.submap) @ T_submap_keyframe
    return float(np.linalg.norm(T_world_keyframe[:3, 3] - last.position))
