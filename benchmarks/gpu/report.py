"""What the parts of the GPU benchmark share: the plan, tables, and clocks."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import torch

UNTIMED = "interpreter"


@dataclass(frozen=True)
class Plan:
    """What to measure, and on what.

    Attributes:
        device: "cuda", or "cpu" for Triton's interpreter.
        size: of the image. counts: of Gaussians. channels: 3 colour, 1 depth, and features.
        repeats: behind each median. frames: of a walk or a recording.
    """

    device: str
    size: tuple[int, int]
    counts: tuple[int, ...]
    channels: tuple[int, ...]
    repeats: int
    frames: int

    @property
    def timed(self) -> bool:
        """Whether times mean anything: the interpreter's do not."""
        return self.device == "cuda"


def table(title: str, *columns: str) -> None:
    """Start a Markdown table."""
    print(f"\n{title}\n\n| " + " | ".join(columns) + " |")
    print("|" + " ---: |" * len(columns), flush=True)


def row(*cells: object) -> None:
    """One row of a Markdown table."""
    texts = [f"{c:.3g}" if isinstance(c, float) else str(c) for c in cells]
    print("| " + " | ".join(texts) + " |", flush=True)


def medians_ms(steps: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median of each step on the GPU, all in turn, after three rounds of warming up."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for repeat in range(repeats + 3):
        for name, step in steps.items():
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            step()
            end.record()
            end.synchronize()
            if repeat >= 3:
                times[name].append(start.elapsed_time(end))
    return {name: statistics.median(values) for name, values in times.items()}


class Stopwatch:
    """A recorder of whole stages: waits for the GPU at both ends of those it is asked for."""

    def __init__(self, device: str, *stages: str) -> None:
        self._device = device
        self.ms: dict[str, list[float]] = {stage: [] for stage in stages}

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """See Recorder."""
        if stage not in self.ms:
            yield
            return
        start = self._now()
        yield
        self.ms[stage].append(1e3 * (self._now() - start))

    def median_ms(self, stage: str) -> float:
        """Median time of a stage, nan where it never ran."""
        return statistics.median(self.ms[stage]) if self.ms[stage] else float("nan")

    def _now(self) -> float:
        if self._device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()
