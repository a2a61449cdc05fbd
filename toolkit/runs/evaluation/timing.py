"""Execution times of the stages of a run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class StageTime:
    """Times of one stage.

    Attributes:
        stage: name of the stage; stages may be nested.
        calls: number of calls.
        total_s: total time of all calls, in seconds.
        median_ms: median time per call, in milliseconds.
    """

    stage: str
    calls: int
    total_s: float
    median_ms: float


class StageRecorder:
    """A `Recorder` that stores every duration."""

    def __init__(self) -> None:
        self.durations_ms: dict[str, list[float]] = {}

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Measure the time of the block, also if it raises an exception."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed_ms = 1e3 * (time.perf_counter() - start)
            self.durations_ms.setdefault(stage, []).append(elapsed_ms)

    def total_ms(self, *stages: str) -> float | None:
        """Return the total time of some stages in milliseconds, None if none of them ran."""
        durations = [d for stage in stages for d in self.durations_ms.get(stage, [])]
        return sum(durations) if durations else None

    def stage_times(self) -> list[StageTime]:
        """Return the times of all stages, sorted by decreasing total time."""
        times = [
            StageTime(
                stage=stage,
                calls=len(durations),
                total_s=sum(durations) / 1e3,
                median_ms=float(np.median(durations)),
            )
            for stage, durations in self.durations_ms.items()
        ]
        return sorted(times, key=lambda item: -item.total_s)
