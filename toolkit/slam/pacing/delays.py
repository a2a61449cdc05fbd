"""What real-time operation did: the delay of every frame, and what was skipped."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any, Literal, Protocol

import numpy as np

from toolkit.slam.mapping.deferred import StepCounts

Outcome = Literal["tracked", "keyframe", "doubtful", "lost", "dropped"]
Metrics = dict[str, Any]


@dataclass(frozen=True)
class FrameDelay:
    """Arrival and delay of a frame.

    Attributes:
        index: the frame's index.
        arrival_s: time of arrival since that of frame 0.
        delay_s: time from the arrival to the result; None for a dropped frame.
        outcome: what became of the frame.
    """

    index: int
    arrival_s: float
    delay_s: float | None
    outcome: Outcome


class DelaySummary(Protocol):
    """The delays of a run in real time, as in its results."""

    @property
    def delays(self) -> Sequence[FrameDelay]:
        """One entry per frame."""

    @property
    def max_delay_s(self) -> float | None:
        """The bound of the delay; None without one."""

    def metrics(self) -> Metrics:
        """Groups of metrics.json, with units in the keys."""

    def csv(self) -> str:
        """Table of the delays, one row per frame."""


@dataclass(frozen=True)
class PaceSummary:
    """The record of a whole run.

    Attributes:
        fps: frames per second.
        max_delay_s: the bound of the delay.
        delays: one entry per frame.
        keyframes_thinned: number of frames that would have become keyframes with more time.
        steps: optimisation steps.
    """

    fps: float
    max_delay_s: float
    delays: Sequence[FrameDelay]
    keyframes_thinned: int
    steps: StepCounts

    @property
    def dropped(self) -> int:
        """Number of dropped frames."""
        return count_of("dropped", self.delays)

    def metrics(self) -> Metrics:
        """Group "pace" of metrics.json, with units in the keys."""
        max_delay_s = self.max_delay_s
        metrics: Metrics = {
            "fps": self.fps,
            "delay_bound_ms": 1e3 * max_delay_s,
            **delay_statistics(self.delays),
            "frames_late": sum((row.delay_s or 0.0) > max_delay_s for row in self.delays),
            "frames_dropped": self.dropped,
            "keyframes_thinned": self.keyframes_thinned,
            "mapping_steps_due": self.steps.due,
            "mapping_steps_deferred": self.steps.late,
            "mapping_steps_skipped": self.steps.due - self.steps.taken,
            "convention": "delay from a frame's arrival to its pose, without dropped frames; late "
            "frames exceed the bound; deferred steps were taken after the next keyframe; dropped "
            "frames are scored at the last pose before them; these results depend on the speed of "
            "the machine and are not reproducible",
        }
        return {"pace": metrics}

    def csv(self) -> str:
        """Table of the delays, one row per frame."""
        return delays_csv(self.delays)


def count_of(outcome: Outcome, delays: Sequence[FrameDelay]) -> int:
    """Number of frames with an outcome."""
    return sum(row.outcome == outcome for row in delays)


def delay_statistics(delays: Sequence[FrameDelay]) -> Metrics:
    """Median, 95th percentile and maximum of the delays; None if no frame has one."""
    delays_ms = np.array([1e3 * row.delay_s for row in delays if row.delay_s is not None])
    known = len(delays_ms) > 0
    return {
        "delay_median_ms": float(np.median(delays_ms)) if known else None,
        "delay_p95_ms": float(np.percentile(delays_ms, 95)) if known else None,
        "delay_max_ms": float(delays_ms.max()) if known else None,
    }


def delays_csv(delays: Sequence[FrameDelay]) -> str:
    """Table of delays, one row per frame."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "arrival_s", "delay_s", "outcome"))
    for row in delays:
        delay = "" if row.delay_s is None else f"{row.delay_s:.6f}"
        writer.writerow((row.index, f"{row.arrival_s:.6f}", delay, row.outcome))
    return text.getvalue()


class PaceRecord:
    """Collects the delays and counts of a run; its state is part of checkpoints."""

    def __init__(self) -> None:
        self.delays: list[FrameDelay] = []
        self.keyframes_thinned = 0

    def values(self) -> dict[str, Any]:
        """JSON values for `restore`."""
        rows = [astuple(row) for row in self.delays]
        return {"delays": rows, "keyframes_thinned": self.keyframes_thinned}

    def restore(self, values: dict[str, Any]) -> None:
        """Restore earlier `values`."""
        self.delays = [FrameDelay(*row) for row in values["delays"]]
        self.keyframes_thinned = int(values["keyframes_thinned"])
