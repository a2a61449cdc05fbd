"""SLAM of live frames: measures the delay of each pose and counts dropped frames."""

from __future__ import annotations

import time
from typing import Any

from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.runs.live.buffer import DroppedFrame
from toolkit.runs.live.feed import LiveFeed
from toolkit.runs.live.summary import LiveSummary
from toolkit.slam.pacing.delays import FrameDelay
from toolkit.slam.pacing.paced import PacedSlam, outcome_of
from toolkit.slam.result import FrameResult
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.system import Slam


class LiveSlam:
    """Processes the frames of a feed.

    Args:
        slam: the system.
        paced: what paces it, None to process each frame completely.
        feed: source of the frames.
        keeps_dropped: give dropped frames the last pose before them, as frames of a dataset.
    """

    def __init__(
        self, slam: Slam, paced: PacedSlam | None, feed: LiveFeed, keeps_dropped: bool
    ) -> None:
        self._slam, self._paced, self._feed = slam, paced, feed
        self._keeps_dropped = keeps_dropped
        self._delays: list[FrameDelay] = []
        self._numbered = 0
        self._origin_s: float | None = None
        if paced is not None:
            feed.idle = paced.work

    @property
    def atlas(self) -> Atlas:
        """All submaps of the system."""
        return self._slam.atlas

    def process_frame(self, frame: Frame, may_map: bool = True) -> FrameResult:
        """Process the frame that the feed has yielded, after those that were dropped before it."""
        self._drop(self._feed.delivery.dropped)
        captured = self._feed.delivery.captured
        assert captured is not None and captured.frame is frame
        if self._paced is None:
            result = self._slam.process_frame(frame, may_map)
        else:
            result = self._paced.process_frame(frame, may_map, captured.captured_s)
        delay_s = None if result.dropped else time.monotonic() - captured.captured_s
        self._add(captured.captured_s, delay_s, outcome_of(result))
        return result

    def summary(self, camera: str) -> LiveSummary:
        """The delays of all frames, those that were dropped at the end included."""
        self._drop(self._feed.left)
        pace = None if self._paced is None else self._paced.summary()
        return LiveSummary(camera, tuple(self._delays), pace)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """State of the SLAM system; delays are not included."""
        return (self._paced or self._slam).state()

    def _drop(self, dropped: tuple[DroppedFrame, ...]) -> None:
        for frame in dropped:
            if self._keeps_dropped:
                self._slam.drop_frame(frame)
            self._add(frame.captured_s, None, "dropped")

    def _add(self, captured_s: float, delay_s: float | None, outcome: Any) -> None:
        if self._origin_s is None:
            self._origin_s = captured_s
        row = FrameDelay(len(self._delays), captured_s - self._origin_s, delay_s, outcome)
        self._delays.append(row)
