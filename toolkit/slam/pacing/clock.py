"""Time, as real-time operation measures it."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Measures time in seconds from an arbitrary origin."""

    def now_s(self) -> float:
        """The current time."""
        ...

    def sleep_until(self, time_s: float) -> None:
        """Wait until a time; return at once if it has passed."""
        ...


class MonotonicClock:
    """The clock of the machine, `time.monotonic`."""

    def now_s(self) -> float:
        """The current time."""
        return time.monotonic()

    def sleep_until(self, time_s: float) -> None:
        """Wait until a time."""
        remaining_s = time_s - self.now_s()
        if remaining_s > 0:
            time.sleep(remaining_s)


class ArrivalSchedule:
    """Frames that arrive at equal intervals from the first one on.

    The timestamps of a recording are not used, so that `--pace 30` means 30 frames per second for
    every recording.

    Args:
        fps: frames per second, positive.
    """

    def __init__(self, fps: float) -> None:
        self.period_s = 1.0 / fps
        self._origin_s: float | None = None

    def start(self, index: int, now_s: float) -> None:
        """Let frame `index` arrive now; only the first call has an effect."""
        if self._origin_s is None:
            self._origin_s = now_s - index * self.period_s

    def arrival_s(self, index: int) -> float:
        """Time at which frame `index` arrives, on the clock of `start`."""
        assert self._origin_s is not None, "the schedule has not been started"
        return self._origin_s + index * self.period_s

    def camera_time_s(self, arrival_s: float) -> float:
        """Time of an arrival since that of frame 0, which a resumed run did not observe."""
        assert self._origin_s is not None, "the schedule has not been started"
        return arrival_s - self._origin_s
