"""Relocalisation of a lost camera: keyframe retrieval, then alignment to the submap."""

from __future__ import annotations

import logging
from collections.abc import Sequence
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
from toolkit.tracking.evidence import likeness
from toolkit.tracking.health import has_depth
from toolkit.tracking.reach import Reach
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


# Number of most similar keyframes that are matched with the frame, and number retrieved for each of
# them, before those out of reach are removed.
_TRIES, _POOL_FACTOR = 5, 4
# Distance from a camera of the keyframes that show the same view.
_SEEN_FROM_M = 2.0
# Poses farther apart are different places, and a frame may be at either of them if its likeness at
# one is this fraction of that at the other one.
_APART_M, _APART_RAD, _AS_ALIKE = 0.3, 0.3, 0.95
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
        found = []
        for match in self._matches(frame, atlas, reach, part):
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
        placed = [(one, atlas.T_world_submap(one.submap) @ one.T_submap_camera) for one in found]
        return _only_place([(one, T) for one, T in placed if reach is None or reach.contains(T)])

    def _matches(
        self, frame: Frame, atlas: Atlas, reach: Reach | None, part: Sequence[int]
    ) -> list[SimilarKeyframe]:
        """The keyframes most similar to a frame, of those that may show what is in reach."""
        view = Keyframe.from_frame(frame, np.eye(4))
        if reach is None:
            return self._detector.most_similar(view, _TRIES)
        found = self._detector.most_similar(view, _POOL_FACTOR * _TRIES)
        metres = reach.metres + _SEEN_FROM_M
        known = [s for s in found if s.submap in part]
        return [s for s in known if _distance_m(s, atlas, reach) <= metres][:_TRIES]

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


def _only_place(found: Sequence[tuple[Relocalisation, NDArray]]) -> Relocalisation | None:
    """The likeliest result; None without any, or if another place looks like the frame, too.

    Args:
        found: results with the poses T_world_camera [4, 4].
    """
    if not found:
        return None
    best, T_best = max(found, key=lambda one: _likeness(one[0]))
    same_place = Reach(T_best, _APART_M, _APART_RAD)
    others = (other for other, T in found if not same_place.contains(T))
    if any(_likeness(other) > _AS_ALIKE * _likeness(best) for other in others):
        return None
    return best


def _likeness(found: Relocalisation) -> float:
    return likeness(found.result.similarity)


def _distance_m(match: SimilarKeyframe, atlas: Atlas, reach: Reach) -> float:
    """Distance from the likeliest camera position to a keyframe, metres; infinite if unknown."""
    T_submap_keyframe = atlas.keyframe_poses(match.submap).get(match.frame)
    if T_submap_keyframe is None:
        return np.inf
    T_world_keyframe = atlas.T_world_submap(match.submap) @ T_submap_keyframe
    return float(np.linalg.norm((T_world_keyframe - reach.T_map_camera)[:3, 3]))
