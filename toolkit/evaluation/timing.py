"""How long each stage of a run took."""

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
        stage: its name; stages may lie within each other.
        calls: how often it ran.
        total_s: seconds, all calls together.
        median_ms, max_ms: milliseconds a call.
    """

    stage: str
    calls: int
    total_s: float
    median_ms: float
    max_ms: float


class StageRecorder:
    """A `Recorder` that keeps every duration and every counted number."""

    def __init__(self) -> None:
        self.durations_ms: dict[str, list[float]] = {}
        self.counts: dict[str, list[float]] = {}

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Time the block, also when it raises."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed_ms = 1e3 * (time.perf_counter() - start)
            self.durations_ms.setdefault(stage, []).append(elapsed_ms)

    def count(self, name: str, value: float) -> None:
        """Keep a number."""
        self.counts.setdefault(name, []).append(float(value))

    def total_ms(self, *stages: str) -> float | None:
        """Milliseconds of all calls together, None where none of the stages ever ran."""
        durations = [d for stage in stages for d in self.durations_ms.get(stage, [])]
        return sum(durations) if durations else None

    def median_ms(self, stage: str) -> float | None:
        """Milliseconds of a usual call, None for a stage that never ran."""
        durations = self.durations_ms.get(stage)
        return float(np.median(durations)) if durations else None

    def stage_times(self) -> list[StageTime]:
        """All stages, the longest first."""
        times = [
            StageTime(
                stage=stage,
                calls=len(durations),
                total_s=sum(durations) / 1e3,
                median_ms=float(np.median(durations)),
                max_ms=max(durations),
            )
            for stage, durations in self.durations_ms.items()
        ]
        return sorted(times, key=lambda item: -item.total_s)
