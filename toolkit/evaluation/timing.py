"""Times and counts of the stages of a run."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


class Stopwatch:
    """A Recorder that keeps every duration in milliseconds."""

    def __init__(self) -> None:
        self.durations_ms: dict[str, list[float]] = defaultdict(list)
        self.values: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Time one piece of work."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.durations_ms[stage].append(1e3 * (time.perf_counter() - begin))

    def count(self, name: str, value: float) -> None:
        """Keep a number."""
        self.values[name].append(value)

    def total_s(self, stage: str) -> float:
        """Seconds spent in a stage."""
        return float(np.sum(self.durations_ms.get(stage, [0.0]))) / 1e3

    def median_ms(self, stage: str) -> float | None:
        """Median duration of a stage, None if it never ran."""
        durations = self.durations_ms.get(stage)
        return float(np.median(durations)) if durations else None
