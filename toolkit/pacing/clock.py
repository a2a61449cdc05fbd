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
