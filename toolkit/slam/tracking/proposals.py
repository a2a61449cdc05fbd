"""Initial poses of a frame from feature matches, for motions that alignment cannot follow."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.splatting.alignment.matching import KeypointCache, match_features

Array = NDArray[np.float64]

# Initial poses T_map_camera [4, 4] of a frame, the likeliest first. They are computed on demand.
Proposals = Callable[[Frame], Iterator[Array]]

# Number of newest keyframes that a frame is matched with.
_RECENT = 3
# Fewer matches than for a loop: a wrong pose is found out after alignment.
_MIN_MATCHES = 7


class FeatureProposals:
    """Matches frames with the newest keyframes, and with those that look most similar."""

    def __init__(self) -> None:
        self._keypoints = KeypointCache(8)

    def poses(
        self,
        frame: Frame,
        keyframes: Sequence[Keyframe],
        similar: Callable[[Keyframe], Sequence[Keyframe]],
    ) -> Iterator[Array]:
        """Poses T_map_camera [4, 4] of a frame with depth, one for each keyframe that matches.

        Args:
            keyframes: those of the map, in order.
            similar: keyframes that look most similar to a view, most similar first.
        """
        if not keyframes:
            return
        view = Keyframe.from_frame(frame, np.eye(4))
        recent = list(keyframes[: -_RECENT - 1 : -1])
        yield from self._matched(view, recent)
        yield from self._matched(view, [k for k in similar(view) if k not in recent])

    def _matched(self, view: Keyframe, keyframes: Sequence[Keyframe]) -> Iterator[Array]:
        for keyframe in keyframes:
            matched = match_features(keyframe, view, self._keypoints)
            if matched is None:
                continue
            motion = matched.motion(np.random.default_rng(0), _MIN_MATCHES)
            if motion is not None:
                yield keyframe.T_map_camera @ motion[0]
