"""Clocks: that of the machine, and one for tests that advances only on request."""

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


class SimulatedClock:
    """A clock that advances by `advance` and by sleeping; results do not depend on the machine."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        """The current time."""
        return self._now_s

    def sleep_until(self, time_s: float) -> None:
        """Advance to a time."""
        self._now_s = max(self._now_s, time_s)

    def advance(self, duration_s: float) -> None:
        """Advance by a duration."""
        self._now_s += duration_s
