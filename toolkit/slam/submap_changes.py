"""Changes of the active submap while the camera is tracked: the next one, or one seen before."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.frame import Frame, FrameStamp, Recorder
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.base.stages import Stage
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.loops.relocalisation import Relocalisation
from toolkit.slam.mapping.boundary import start_next
from toolkit.slam.mapping.keyframes import RECENT, SEEN, is_revisit, seen_fraction, view_motions
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.tracking.result import Health, TrackingResult
from toolkit.slam.tracking.tracker import LocatingTracker

_log = logging.getLogger(__name__)

# A submap shows a view again if it explains at least this fraction of what the active one explains.
_MIN_EXPLAINED = 0.9
# Maximum motion between its predicted and its found pose there, as translation over median depth
# plus radians.
_MAX_MOTION = 0.05
# Larger motions between views, in the same unit, are not considered, and smaller differences of
# them are errors of the poses.
_SIMILAR, _SAME_VIEW = 1.0, 0.002
# A view that the active submap no longer shows is continued in another one if that explains and
# has measured at least this fraction of it.
_MIN_PARTLY = 0.5
# Number of frames for which the camera stays in a submap that it has entered.
_MIN_STAY = 10
# Number of keyframes of new submaps that earlier ones show before the camera returns to these.
# Loops need the overlap: on twin rooms, returning at once raises the error from 0.8 to 1.3 cm.
_MIN_SHARED = 60


@dataclass(frozen=True)
class _Candidate:
    """A submap in which the camera may continue.

    Attributes:
        number: of the submap.
        T_submap_camera: [4, 4] predicted pose of the frame.
        partly: whether it shows only a part of the frame, and is to be extended.
    """

    number: int
    T_submap_camera: NDArray[np.float64]
    partly: bool = False


@dataclass(frozen=True)
class SeenAgain:
    """A view that another submap shows.

    Attributes:
        found: the frame in that submap; None if the camera should stay in the active one.
    """

    found: Relocalisation | None


class SubmapChanges:
    """Starts submaps, and continues in the earlier one that shows what the camera sees.

    Without the latter, every visit of a place would map it again, and a map would grow with the
    time that the camera spends in it.
    """

    def __init__(
        self, front_end: FrontEnd, mapper: Mapper, atlas: Atlas, recorder: Recorder
    ) -> None:
        self._tracker, self._closer = front_end.tracker, front_end.closer
        self._mapper, self._atlas, self._recorder = mapper, atlas, recorder
        self._entered_at = -_MIN_STAY
        # Keyframes of new submaps that earlier ones show, less those that none shows.
        self._shared = 0

    def start_if_due(self, tracking: TrackingResult | None) -> None:
        """Start the next submap at the newest keyframe if allocation asks for it.

        Args:
            tracking: of the keyframe.
        """
        atlas = self._atlas
        verdict = atlas.judge()
        if verdict is None or not verdict.starts_submap:
            return
        T_new_old = self._closer.submap_ending(atlas, self._mapper)
        if T_new_old is not None:
            self._tracker.change_frame(T_new_old)
        ended = atlas.active
        with self._recorder.timed(Stage.MAPPING):
            self._tracker.change_frame(start_next(atlas, self._mapper))
        _log.info("Started submap %d at frame %d: %s.", atlas.active, verdict.index, verdict.reason)
        information = np.zeros((6, 6)) if tracking is None else tracking.information
        self._closer.submap_started(atlas, ended, information)

    def seen_again(
        self, frame: Frame, T_map_camera: NDArray[np.float64], tracking: TrackingResult | None
    ) -> SeenAgain | None:
        """Whether another submap shows a frame that the active one does not; None if none does.

        The frame is located there, unless the active submap was entered shortly before. It must be
        found where the poses of the submaps predict it, so that a place that only looks the same
        is not entered.

        Args:
            T_map_camera: [4, 4] pose in the active submap.
            tracking: of the frame, by which that pose was found.
        """
        candidate = self._nearest(frame, T_map_camera)
        if not self._overlaps_enough(None if candidate is None else candidate.number):
            return None
        stays = frame.index - self._entered_at < _MIN_STAY
        if candidate is None and self._atlas.visited > 0:
            full = self._atlas.is_full(self._atlas.current)
            if not self._leaves(frame, T_map_camera, full):
                return SeenAgain(None) if full else None
            candidate = None if stays else self._largest_part(frame, T_map_camera)
        if candidate is None or tracking is None:
            return None
        if stays:
            return SeenAgain(None)
        found = self._located(frame, candidate, tracking)
        return None if found is None else SeenAgain(found)

    def _located(
        self, frame: Frame, candidate: _Candidate, tracking: TrackingResult
    ) -> Relocalisation | None:
        """The frame in a candidate, if it is found where it is predicted, and shown there."""
        if not isinstance(self._tracker, LocatingTracker):
            return None
        number, T_predicted = candidate.number, candidate.T_submap_camera
        submap = self._atlas.submap(number)
        gaussians = submap.gaussians.to(self._atlas.device)
        with self._recorder.timed(Stage.RELOCALISATION):
            result = self._tracker.locate(frame, gaussians, T_predicted, search=False)
        fraction = _MIN_PARTLY if candidate.partly else _MIN_EXPLAINED
        explained = result.visible_fraction >= fraction * tracking.visible_fraction
        if result.health is not Health.GOOD or not explained:
            return None
        if _motion(frame, [T_predicted], result.T_map_camera)[0] >= _MAX_MOTION:
            return None
        if candidate.partly:
            part = seen_fraction(submap.keyframes, frame, result.T_map_camera)
            shown = part >= _MIN_PARTLY
        else:
            shown = self._shows(submap.keyframes, frame, result.T_map_camera)
        return Relocalisation(number, result) if shown else None

    def enter(
        self, again: Relocalisation, frame: FrameStamp, T_map_camera: NDArray[np.float64]
    ) -> None:
        """Continue in an earlier submap, in which a frame was located.

        Args:
            T_map_camera: [4, 4] pose of the frame in the active submap.
        """
        self._entered_at = frame.index
        atlas, ended = self._atlas, self._atlas.active
        T_new_old = self._closer.submap_ending(atlas, self._mapper)
        T_ended_camera = T_map_camera if T_new_old is None else T_new_old @ T_map_camera
        self._mapper.skip_deferred_steps()
        with self._recorder.timed(Stage.MAPPING):
            atlas.enter(again.submap)
        self._tracker.change_frame(again.T_submap_camera @ se3.inverse(T_map_camera))
        _log.info("Continued in submap %d at frame %d.", again.submap, frame.index)
        self._closer.submap_entered(atlas, ended, T_ended_camera, again)

    def _nearest(self, frame: Frame, T_map_camera: NDArray[np.float64]) -> _Candidate | None:
        """The submap with the nearest view among those that show a frame."""
        found, least = None, _SIMILAR
        if self._mapper.options.keyframes.revisit == 0.0:
            return None
        for number, nearest, T_submap_camera in self._others(frame, T_map_camera):
            # The boundary keyframe of two submaps is in both: the newer one is nearer in time.
            submap = self._read(number, frame) if nearest < least + _SAME_VIEW else None
            if submap is not None and self._shows(submap.keyframes, frame, T_submap_camera):
                found, least = _Candidate(number, T_submap_camera), min(nearest, least)
        return found

    def _leaves(self, frame: Frame, T_map_camera: NDArray[np.float64], full: bool) -> bool:
        """Whether the camera leaves an earlier submap that it has entered, if that is complete."""
        atlas = self._atlas
        if not (full or atlas.has_enough(atlas.keyframes)):
            return False
        established = atlas.established_keyframes
        return seen_fraction(established, frame, T_map_camera) < _MIN_PARTLY

    def _largest_part(self, frame: Frame, T_map_camera: NDArray[np.float64]) -> _Candidate | None:
        """The submap that shows most of a frame that the active one does not show."""
        found, most = None, _MIN_PARTLY
        for number, nearest, T_submap_camera in self._others(frame, T_map_camera):
            submap = self._read(number, frame) if nearest < _SIMILAR else None
            if submap is None or self._atlas.is_full(submap):
                continue
            part = seen_fraction(submap.keyframes, frame, T_submap_camera)
            if part >= most:
                found, most = _Candidate(number, T_submap_camera, partly=True), part
        return found

    def _others(
        self, frame: Frame, T_map_camera: NDArray[np.float64]
    ) -> Iterator[tuple[int, float, NDArray[np.float64]]]:
        """Submaps that can be entered: number, motion to the nearest view, pose of the frame."""
        atlas = self._atlas
        if not atlas.keyframes:
            return
        T_world_camera = atlas.T_world_submap(atlas.active) @ T_map_camera
        for number in self._closer.enterable(atlas):
            T_submap_camera = se3.inverse(atlas.T_world_submap(number)) @ T_world_camera
            views = list(atlas.keyframe_poses(number).values())
            nearest = float(_motion(frame, views, T_submap_camera).min(initial=np.inf))
            yield number, nearest, T_submap_camera

    def _read(self, number: int, frame: FrameStamp) -> Submap | None:
        """A submap; None if it cannot be read."""
        try:
            return self._atlas.submap(number)
        except ToolkitError as error:
            _log.debug("frame %d: %s", frame.index, error)
            return None

    def _overlaps_enough(self, number: int | None) -> bool:
        """Whether the newest submaps show enough of earlier ones for accurate loops; count this.

        That matters once for each place: where a new submap returns to one that a loop connects.

        Args:
            number: of the submap that shows the newest view; None if none does.
        """
        atlas = self._atlas
        if atlas.visited > 0:
            return True
        if number is not None and number == self._closer.origin(atlas):
            # Its newest keyframes are of the same visit.
            return len(atlas.keyframes) >= RECENT
        change = -1 if number is None else 1
        self._shared = min(max(0, self._shared + change), _MIN_SHARED + 1)
        return self._shared > _MIN_SHARED

    def _shows(
        self, keyframes: list[Keyframe], frame: Frame, T_submap_camera: NDArray[np.float64]
    ) -> bool:
        """Whether a frame would not become a keyframe of an inactive submap."""
        revisit = self._mapper.options.keyframes.revisit
        again = is_revisit(keyframes, T_submap_camera, revisit, len(keyframes))
        return again or self.shows_surface(keyframes, frame, T_submap_camera)

    def shows_surface(
        self, keyframes: list[Keyframe], frame: Frame, T_submap_camera: NDArray[np.float64]
    ) -> bool:
        """Whether a submap has enough keyframes, and they have measured what a frame shows."""
        if not self._atlas.has_enough(keyframes):
            return False
        return seen_fraction(keyframes, frame, T_submap_camera) >= SEEN

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """JSON values from which `restore` continues identically."""
        return {}, {"entered_at": self._entered_at, "shared": self._shared}

    def restore(self, _arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self._entered_at = int(values["entered_at"])
        self._shared = int(values["shared"])


def _motion(
    frame: Frame, T_map_views: list[NDArray[np.float64]], T_map_camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Motions [K] between K views and a frame: translation over median depth plus radians."""
    metres, radians = view_motions(T_map_views, T_map_camera)
    measured = frame.depth_m[frame.depth_m > 0]
    return metres / float(np.median(measured)) + radians
