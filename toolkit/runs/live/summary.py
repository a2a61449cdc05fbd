"""What a live run did: the delay of every captured frame, and which frames were dropped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from toolkit.slam.pacing.delays import (
    FrameDelay,
    Metrics,
    PaceSummary,
    count_of,
    delay_statistics,
    delays_csv,
)


@dataclass(frozen=True)
class LiveSummary:
    """The record of a live run.

    Attributes:
        camera: name of the camera.
        delays: one entry per captured frame, in order.
        pace: decisions of a run with --pace, None for other runs.
    """

    camera: str
    delays: Sequence[FrameDelay]
    pace: PaceSummary | None = None

    @property
    def dropped(self) -> int:
        """Number of frames that were captured but not processed."""
        return count_of("dropped", self.delays)

    @property
    def max_delay_s(self) -> float | None:
        """The bound of the delay; None without --pace."""
        return None if self.pace is None else self.pace.max_delay_s

    @property
    def captured_fps(self) -> float | None:
        """Frames that the camera captured per second; None with less than two frames."""
        if len(self.delays) < 2:
            return None
        duration_s = self.delays[-1].arrival_s - self.delays[0].arrival_s
        return (len(self.delays) - 1) / duration_s if duration_s > 0 else None

    def metrics(self) -> Metrics:
        """Groups "live" and "pace" of metrics.json, with units in the keys."""
        metrics: Metrics = {
            "camera": self.camera,
            "frames_captured": len(self.delays),
            "frames_dropped": self.dropped,
            "captured_fps": self.captured_fps,
            **delay_statistics(self.delays),
            "convention": "delay from the capture of a frame to its pose, without dropped frames; "
            "dropped frames of a dataset, and frames that --pace drops, are scored at the last "
            "pose before them; other dropped frames of a camera are not scored; these results "
            "depend on the speed of the machine and are not reproducible",
        }
        return {"live": metrics} | ({} if self.pace is None else self.pace.metrics())

    def csv(self) -> str:
        """Table of the delays, one row per captured frame."""
        return delays_csv(self.delays)
