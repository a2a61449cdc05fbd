"""Localisation in a map of unknown scale, which is a file of splats without cameras.

A frame with depth is matched with virtual views of the map. Three matches with depth on both sides
determine pose and scale. Dense alignment at that scale, as for a lost camera, decides whether the
pose is right.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.matching import (
    MIN_MATCHES,
    KeypointCache,
    match_features,
    similarity_fits,
)
from toolkit.features.keypoints import similarity_votes
from toolkit.frame import Frame
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.keyframe import Keyframe
from toolkit.loops.options import RelocalisationOptions
from toolkit.loops.relocalisation import is_found
from toolkit.tracking.health import has_depth
from toolkit.tracking.tracker import LocatingTracker

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

# Number of the most similar views that a frame is matched with, and of the best of these that are
# aligned.
_MATCHED, _ALIGNED = 16, 3
# Frames that suffice to determine the scale, and the number of them that must agree on it within a
# factor.
_ENOUGH, _AGREEING, _MAX_FACTOR = 8, 2, 1.05


@dataclass(frozen=True, eq=False)
class LocatedFrame:
    """A frame located in a map of unknown scale.

    Attributes:
        index: of the frame.
        units_per_metre: scale of the map.
        T_map_camera: [4, 4] pose in the map, scaled to metres.
        matches: number of matches with a view of the map.
    """

    index: int
    units_per_metre: float
    T_map_camera: Array
    matches: int


class SplatMapLocaliser:
    """Locates frames in a map of unknown scale.

    Args:
        cloud: the map; its extent should be that of a room, in an approximate metre.
        views: virtual views of it.
        tracker: aligns frames to the map.
        options: what a pose must fulfil.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        views: Sequence[Keyframe],
        tracker: LocatingTracker,
        options: RelocalisationOptions,
    ) -> None:
        self._cloud, self._views, self._tracker = cloud, views, tracker
        self._options = options
        self._keypoints = KeypointCache(len(views) + 1)

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
        guesses = []
        for view in self._similar(keyframe):
            matched = match_features(view, keyframe, self._keypoints)
            if matched is None:
                continue
            generator = np.random.default_rng(0)
            motion = matched.motion(generator, MIN_MATCHES, similarity_fits)
            if motion is not None:
                guesses.append((motion[1], view.T_map_camera @ motion[0]))
        guesses.sort(key=lambda guess: -guess[0])
        for matches, S_map_camera in guesses[:_ALIGNED]:
            found = self._confirmed(frame, S_map_camera, matches)
            if found is not None:
                return found
        _log.debug("frame %d: %d of the views match", frame.index, len(guesses))
        return None

    def _similar(self, keyframe: Keyframe) -> list[Keyframe]:
        """The views with most similar keypoints, of any rotation about the viewing direction."""
        keypoints = [*map(self._keypoints, self._views), self._keypoints(keyframe)]
        votes = similarity_votes(keypoints)[-1, :-1]
        order = np.argsort(-votes, kind="stable")[:_MATCHED]
        return [self._views[number] for number in order]

    def _confirmed(self, frame: Frame, S_map_camera: Array, matches: int) -> LocatedFrame | None:
        """Align a frame to the map at the scale of a similarity [4, 4]."""
        units_per_metre = float(np.cbrt(np.linalg.det(S_map_camera[:3, :3])))
        if not 1e-3 < units_per_metre < 1e3:
            return None
        T = S_map_camera.copy()
        T[:3] /= units_per_metre
        metric = self._cloud.scaled(1.0 / units_per_metre)
        result = self._tracker.locate(frame, metric, T, search=False)
        if not is_found(result, self._options):
            return None
        return LocatedFrame(frame.index, units_per_metre, result.T_map_camera, matches)


def _agreeing(found: list[LocatedFrame]) -> list[LocatedFrame]:
    """The largest set of frames whose scales agree."""
    scales = np.array([one.units_per_metre for one in found])
    ratios = np.maximum(scales[:, None] / scales, scales / scales[:, None])
    near = ratios <= _MAX_FACTOR
    best = int(near.sum(axis=1).argmax()) if len(found) else 0
    return [one for one, agrees in zip(found, near[best] if len(found) else [], strict=True) if agrees]
