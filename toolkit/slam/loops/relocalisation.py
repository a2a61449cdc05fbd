"""Relocalisation of a lost camera: keyframe retrieval, then alignment to the submap."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.slam.loops.candidates import SimilarKeyframe
from toolkit.slam.loops.detection import LoopDetector
from toolkit.slam.loops.options import RelocalisationOptions
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.tracking.evidence import likeness
from toolkit.slam.tracking.health import has_depth
from toolkit.slam.tracking.reach import Reach, is_only_place
from toolkit.slam.tracking.result import Health, TrackingResult
from toolkit.slam.tracking.tracker import LocatingTracker
from toolkit.splatting.alignment.matching import measure_offset

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


# Number of most similar keyframes that are matched with the frame, and number retrieved for each of
# them, before those out of reach are removed.
_TRIES, _POOL_FACTOR = 5, 4
# Distance from a camera of the keyframes that show the same view.
_SEEN_FROM_M = 2.0
# A frame may be at another place, too, if its likeness there is this fraction of the best one.
_AS_ALIKE = 0.95
# Minimum fraction of the frame's measured pixels that the map explains: more than for a tracked
# frame, since no neighbouring frame confirms the pose.
_MIN_VISIBLE = 0.4
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
        reach: Reach | None = None,
        part: Sequence[int] = (),
    ) -> Relocalisation | None:
        """Align the frame to the submaps of similar keyframes; returns the best result.

        None if the frame looks the same at different places that the camera can have reached: what
        repeats does not tell where it is.

        Args:
            frame: lost frame.
            atlas: submaps to search.
            tracker: aligns the frame to a submap.
            reach: where the camera may be in the world, None if unknown.
            part: numbers of the submaps whose poses relative to that are known. A frame that looks
                like a place out of reach, or in another part, shows another place that looks the
                same, or a recording with a cut. A submap of unknown position is right for both:
                its loops are verified with all of its keyframes.
        """
        if not has_depth(frame):
            return None
        possible = (lambda _: True) if reach is None else reach.contains
        near, far = self._matches(frame, atlas, reach, part)
        located = self._located(frame, near, atlas, tracker)
        found = [(one, T) for one, T in located if possible(T)]
        if not found:
            return None
        best, T_best = max(found, key=lambda one: _likeness(one[0]))
        located += self._located(frame, far, atlas, tracker)
        alike = [T for other, T in located if _likeness(other) > _AS_ALIKE * _likeness(best)]
        return best if is_only_place(T_best, alike, possible) else None

    def _located(
        self,
        frame: Frame,
        matches: Iterable[SimilarKeyframe],
        atlas: Atlas,
        tracker: LocatingTracker,
    ) -> list[tuple[Relocalisation, NDArray]]:
        """Results of alignment to the submaps of keyframes, with the poses T_world_camera."""
        found = []
        for match in matches:
            try:
                submap = atlas.submap(match.submap)
            except ToolkitError as error:
                # Skip submaps whose file cannot be read.
                _log.debug("frame %d: %s", frame.index, error)
                continue
            for keyframe in submap.keyframes:
                if keyframe.index == match.frame:
                    result = self._align(frame, keyframe, submap, tracker)
                    found += [] if result is None else [result]
        return [(one, atlas.T_world_submap(one.submap) @ one.T_submap_camera) for one in found]

    def _matches(
        self, frame: Frame, atlas: Atlas, reach: Reach | None, part: Sequence[int]
    ) -> tuple[list[SimilarKeyframe], list[SimilarKeyframe]]:
        """The keyframes most similar to a frame that may show what is in reach, and others."""
        view = Keyframe.from_frame(frame, np.eye(4))
        if reach is None:
            return self._detector.most_similar(view, _TRIES), []
        found = self._detector.most_similar(view, _POOL_FACTOR * _TRIES)
        metres = reach.metres + _SEEN_FROM_M
        known = [s for s in found if s.submap in part]
        near = [s for s in known if _distance_m(s, atlas, reach) <= metres]
        return near[:_TRIES], [s for s in known if s not in near][:_TRIES]

    def _align(
        self, frame: Frame, keyframe: Keyframe, submap: Submap, tracker: LocatingTracker
    ) -> Relocalisation | None:
        """Align a frame to a submap, starting from image matches with one of its keyframes."""
        offset = measure_offset(keyframe, Keyframe.from_frame(frame, np.eye(4)))
        if offset is None:
            return None
        start = keyframe.T_map_camera @ offset.T_first_second
        result = tracker.locate(frame, submap.gaussians, start, search=False)
        return Relocalisation(submap.number, result) if is_found(result) else None


def is_found(result: TrackingResult) -> bool:
    """Whether a frame was located so well that its pose needs no neighbouring frame."""
    return (
        result.health is Health.GOOD
        and result.visible_fraction >= _MIN_VISIBLE
        and result.intensity_residual <= _MAX_INTENSITY_RESIDUAL
    )


def _likeness(found: Relocalisation) -> float:
    return likeness(found.result.similarity)


def _distance_m(match: SimilarKeyframe, atlas: Atlas, reach: Reach) -> float:
    """Distance from the likeliest camera position to a keyframe, metres; infinite if unknown."""
    T_submap_keyframe = atlas.keyframe_poses(match.submap).get(match.frame)
    if T_submap_keyframe is None:
        return np.inf
    T_world_keyframe = atlas.T_world_submap(match.submap) @ T_submap_keyframe
    return float(np.linalg.norm((T_world_keyframe - reach.T_map_camera)[:3, 3]))
