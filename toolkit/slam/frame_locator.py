"""Poses of frames: tracked in the active submap, or found by recovery."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, NEUTRAL
from toolkit.base.frame import Frame, Recorder
from toolkit.base.stages import Stage
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.recovery import Located, Recovery
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.proposals import FeatureProposals
from toolkit.slam.tracking.result import not_tracked


class FrameLocator:
    """Tracks each frame, and lets `Recovery` find those that tracking loses."""

    def __init__(
        self, front_end: FrontEnd, atlas: Atlas, recovery: Recovery, recorder: Recorder
    ) -> None:
        self._tracker, self._closer = front_end.tracker, front_end.closer
        self._atlas, self._recovery, self._recorder = atlas, recovery, recorder
        self._features = FeatureProposals()

    def locate(self, frame: Frame, may_map: bool) -> Located:
        """Estimate the pose of a frame in the active submap, or in the one that recovery starts.

        Args:
            may_map: False for a frame that must not start a submap.
        """
        if not self._atlas.has_active_submap:
            lost = not_tracked("the camera has not been relocalised in the loaded map")
            return self._recovery.recover(frame, lost, may_map)
        if not self._atlas.keyframes:
            if not may_map:
                return Located(None, not_tracked("it is held out, and the map has not started"))
            first = self._tracker.first_pose(frame)
            unusable = not_tracked(
                "the map cannot start with it: no pose, blank, or too little depth"
            )
            return Located(first, None if first is not None else unusable)
        with self._recorder.timed(Stage.TRACKING):
            gaussians = self._atlas.gaussians
            tracking = self._tracker.track(self._balanced(frame), gaussians, self._proposals)
        if tracking.lost or tracking.doubtful:
            found = self._recovery.recover(frame, tracking, may_map)
            if tracking.lost or found.T_map_camera is not None:
                return found
        return Located(tracking.T_map_camera, tracking)

    def _proposals(self, frame: Frame) -> Iterator[NDArray[np.float64]]:
        """Initial poses T_map_camera [4, 4] of a frame from its features."""
        keyframes = self._atlas.keyframes
        similar = partial(self._closer.similar_keyframes, self._atlas)
        return self._features.poses(frame, keyframes, similar)

    def _balanced(self, frame: Frame) -> Frame:
        """The frame at the white balance of the last keyframe, which is near its own."""
        balance = self._atlas.keyframes[-1].exposure.balance
        if balance == NEUTRAL:
            return frame
        return replace(frame, rgb=IDENTITY.with_balance(balance).apply(frame.rgb))
