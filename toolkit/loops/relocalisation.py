"""Relocalisation of a lost camera: keyframe retrieval, then alignment to the submap."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.matching import measure_offset
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
        part: numbers of the submaps whose poses relative to this position are known.
    """

    timestamp_s: float
    position: NDArray[np.float64]
    part: tuple[int, ...]


# Number of most similar keyframes that are matched with the frame, and number retrieved for each of
# them, before those out of reach are removed.
_TRIES, _POOL_FACTOR = 5, 4
# Assumed maximum speed of the camera, and distance added to its reach. Of two rooms that look the
# same, it can only have reached the nearer one.
_SPEED_M_S, _SLACK_M = 2.0, 2.0
# Maximum robust scale of the photometric residuals, for intensities in [0, 1]: less than for a
# tracked frame, since no neighbouring frame confirms the pose.
_MAX_INTENSITY_RESIDUAL = 0.1


class Relocaliser:
    """Relocalises lost frames against the keyframes of all submaps."""

    def __init__(
        self, detector: LoopDetector, options: RelocalisationOptions | None = None
    ) -> None:
        self.options = options or RelocalisationOptions()
        self._detector = detector

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
            anywhere: False restricts the search to keyframes in reach of that position. True adds
                those of other parts of the map, whose distance is unknown.
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
        """Keyframes similar to a frame: those in reach first, then those of other parts.

        A frame that looks like a place out of reach shows another place that looks the same, or a
        recording with a cut. A submap of unknown position is right for both: its loops are
        verified with all of its keyframes.
        """
        view = Keyframe.from_frame(frame, np.eye(4))
        if last is None:
            return self._detector.most_similar(view, _TRIES)
        reach_m = _SLACK_M + _SPEED_M_S * abs(frame.timestamp_s - last.timestamp_s)
        found = self._detector.most_similar(view, _POOL_FACTOR * _TRIES)
        near = [s for s in found if _distance_m(s, atlas, last) <= reach_m][:_TRIES]
        others = [s for s in found[:_TRIES] if s.submap not in last.part]
        return near + [s for s in others if anywhere and s not in near]

    def _align(
        self, frame: Frame, keyframe: Keyframe, submap: Submap, tracker: LocatingTracker
    ) -> Relocalisation | None:
        """Align a frame to a submap, starting from image matches with one of its keyframes."""
        offset = measure_offset(keyframe, Keyframe.from_frame(frame, np.eye(4)))
        if offset is None:
            return None
        start = keyframe.T_map_camera @ offset.T_first_second
        result = tracker.locate(frame, submap.gaussians, start, search=False)
        return Relocalisation(submap.number, result) if is_found(result, self.options) else None


def is_found(result: TrackingResult, options: RelocalisationOptions) -> bool:
    """Whether a frame was located so well that its pose needs no neighbouring frame."""
    return (
        result.health is Health.GOOD
        and result.visible_fraction >= options.min_visible
        and result.intensity_residual <= _MAX_INTENSITY_RESIDUAL
    )


def _distance_m(match: SimilarKeyframe, atlas: Atlas, last: LastPosition) -> float:
    """Distance from the last camera position to a keyframe, metres; infinite if unknown."""
    T_submap_keyframe = atlas.keyframe_poses(match.submap).get(match.frame)
    if T_submap_keyframe is None:
        return float("inf")
    T_world_keyframe = atlas.T_world_submap(match.submap) @ T_submap_keyframe
    return float(np.linalg.norm(T_world_keyframe[:3, 3] - last.position))
