"""Localisation in a map of unknown scale, which is a file of splats without cameras.

A frame with depth is matched with virtual views of the map. Three matches with depth on both sides
determine pose and scale. Dense alignment at that scale, as for a lost camera, decides whether the
pose is right.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.semantics.features.keypoints import votes_for
from toolkit.slam.loops.relocalisation import is_found
from toolkit.slam.tracking.health import has_depth
from toolkit.slam.tracking.tracker import LocatingTracker
from toolkit.splatting.alignment.matching import (
    MIN_MATCHES,
    KeypointCache,
    match_features,
    similarity_fits,
)
from toolkit.splatting.gaussians.cloud import GaussianCloud

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

# Number of the most similar views that a frame is matched with, and of the best of these that are
# aligned.
_MATCHED, _ALIGNED = 32, 4
# Minimum number of matches with these, which are far from the frame, and number of views that are
# rendered ever closer to it afterwards.
_FEW_MATCHES, _CLOSER = 8, 2
# Maximum factor between the scale of the map and that of a room.
_MAX_SCALE = 100.0
# Frames that suffice to determine the scale, and the number of them that must agree on it within a
# factor.
_ENOUGH, _AGREEING, _MAX_FACTOR = 8, 2, 1.05


@dataclass(frozen=True, eq=False)
class LocatedFrame:
    """A frame located in a map of unknown scale.

    Attributes:
        index: of the frame.
        units_per_metre: scale of the map.
        T_map_camera: [4, 4] pose in the unit of the map.
        matches: number of matches with a view of the map.
    """

    index: int
    units_per_metre: float
    T_map_camera: Array
    matches: int


@dataclass(frozen=True, eq=False)
class _Guess:
    """A similarity of a frame and the map from matches.

    Attributes:
        S_map_camera: [4, 4] from the camera in metres to the map.
        scale: units of the map per metre.
        matches: number of inliers.
    """

    S_map_camera: Array
    scale: float
    matches: int

    @property
    def T_map_camera(self) -> Array:
        """The pose [4, 4] in the unit of the map."""
        T = self.S_map_camera.copy()
        T[:3, :3] /= self.scale
        return T


class SplatMapLocaliser:
    """Locates frames in a map of unknown scale.

    Args:
        cloud: the map; its extent should be that of a room, in an approximate metre.
        views: virtual views of it.
        render: renders another view from a pose T_map_camera [4, 4]; None where it shows little.
        tracker: aligns frames to the map.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        views: Sequence[Keyframe],
        render: Callable[[Array], Keyframe | None],
        tracker: LocatingTracker,
    ) -> None:
        self._cloud, self._views, self._render = cloud, list(views), render
        self._tracker = tracker
        self._keypoints = KeypointCache(len(views) + 2 * _ENOUGH)

    def located(self, frames: Iterable[Frame]) -> list[LocatedFrame]:
        """Locate frames until enough of them agree on the scale; empty if too few do."""
        found: list[LocatedFrame] = []
        for frame in frames:
            one = self.locate(frame) if has_depth(frame) else None
            if one is not None:
                found.append(one)
            if len(found) == _ENOUGH:
                break
        agreeing = _agreeing(found)
        return agreeing if len(agreeing) >= _AGREEING else []

    def locate(self, frame: Frame) -> LocatedFrame | None:
        """Locate a frame; None if no pose is confirmed by dense alignment."""
        keyframe = Keyframe.from_frame(frame, np.eye(4))
        guesses = [self._guess(view, keyframe, _FEW_MATCHES) for view in self._similar(keyframe)]
        found = sorted((g for g in guesses if g is not None), key=lambda guess: -guess.matches)
        for guess in found[:_ALIGNED]:
            closer = self._closer(guess, keyframe)
            located = None if closer is None else self._confirmed(frame, closer)
            if closer is not None and located is not None:
                # Neighbouring frames are more similar to it than to the other views.
                self._add(self._render(closer.T_map_camera))
                return located
        _log.debug("frame %d: %d of the views match", frame.index, len(found))
        return None

    def _guess(self, view: Keyframe, keyframe: Keyframe, min_matches: int) -> _Guess | None:
        """The similarity of a view and a frame by their matches."""
        matched = match_features(view, keyframe, self._keypoints)
        if matched is None:
            return None
        generator = np.random.default_rng(0)
        motion = matched.motion(generator, min_matches, similarity_fits)
        if motion is None:
            return None
        scale = float(np.cbrt(np.linalg.det(motion[0][:3, :3])))
        if not 1.0 / _MAX_SCALE < scale < _MAX_SCALE:
            return None
        return _Guess(view.T_map_camera @ motion[0], scale, motion[1])

    def _closer(self, guess: _Guess | None, keyframe: Keyframe) -> _Guess | None:
        """The similarity with a view from where the frame seems to be, which has more matches."""
        for _ in range(_CLOSER):
            view = None if guess is None else self._render(guess.T_map_camera)
            guess = None if view is None else self._guess(view, keyframe, MIN_MATCHES)
        return guess

    def _similar(self, keyframe: Keyframe) -> list[Keyframe]:
        """The views with most similar keypoints, of any rotation about the viewing direction."""
        seen = [self._keypoints(view) for view in self._views]
        votes = votes_for(seen, self._keypoints(keyframe))
        order = np.argsort(-votes, kind="stable")[:_MATCHED]
        return [self._views[number] for number in order]

    def _add(self, view: Keyframe | None) -> None:
        if view is not None:
            self._views.append(view)

    def _confirmed(self, frame: Frame, guess: _Guess) -> LocatedFrame | None:
        """Align a frame to the map at the scale of a guess."""
        metric, T = self._cloud.scaled(1.0 / guess.scale), guess.T_map_camera
        T[:3, 3] /= guess.scale
        result = self._tracker.locate(frame, metric, T, search=False)
        if not is_found(result):
            return None
        found = result.T_map_camera.copy()
        found[:3, 3] *= guess.scale
        return LocatedFrame(frame.index, guess.scale, found, guess.matches)


def _agreeing(found: list[LocatedFrame]) -> list[LocatedFrame]:
    """The largest set of frames whose scales agree."""
    logs = np.log([one.units_per_metre for one in found])
    near = np.abs(logs[:, None] - logs) <= np.log(_MAX_FACTOR)
    best = near[int(near.sum(axis=1).argmax())] if found else []
    return list(compress(found, best))
