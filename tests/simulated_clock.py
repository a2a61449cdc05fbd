"""A clock that advances only on request."""

from __future__ import annotations


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
