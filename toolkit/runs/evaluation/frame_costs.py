"""Time and memory of a run, frame by frame, their charts, and the size of a map."""

from __future__ import annotations

import math
import resource
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from toolkit.base.stages import COLUMNS, Column, Stage
from toolkit.runs.evaluation.charts import Axes, Series, line_chart
from toolkit.runs.evaluation.timing import StageRecorder

# A chart has at most this many points; each shows the largest value of some frames.
_MAX_POINTS = 600
# The first map and loop closures take many times the time of other frames; the range of the chart
# follows this percentile, and frames above it are marked.
_RANGE_PERCENTILE, _RANGE_FACTOR = 98.0, 1.3
_STATUS = Path("/proc/self/status")
_STATM = Path("/proc/self/statm")
_FLOAT_BYTES = 4
# Centre, radius, opacity and colour.
_GEOMETRY_FLOATS = 3 + 1 + 1 + 3


@dataclass(frozen=True)
class FrameCosts:
    """Time and memory of F frames.

    Attributes:
        frames: [F] frame indices, ascending.
        total_ms: [F] time from taking a frame to its result, with loop closure.
        columns_ms: [F] what each column has of it; the rest is in none.
        memory_mb: [F] resident memory of the process after the frame, nan where unknown.
    """

    frames: NDArray[np.int64]
    total_ms: NDArray[np.float64]
    columns_ms: dict[Column, NDArray[np.float64]]
    memory_mb: NDArray[np.float64]


class FrameCostRecorder:
    """Assigns the times of a recorder to frames.

    Attributes:
        recorder: records the stages of tracking and mapping, and "frame".
    """

    def __init__(self, recorder: StageRecorder) -> None:
        self.recorder = recorder
        self._known: dict[str, int] = {}
        self._rows: list[tuple[float, ...]] = []

    @contextmanager
    def frame(self, index: int) -> Iterator[None]:
        """Measure the stage "frame" and what it contains; then store it with the memory."""
        with self.recorder.timed(Stage.FRAME):
            yield
        times = [self._new_ms(stages) for stages in ((Stage.FRAME,), *COLUMNS.values())]
        memory_mb = resident_memory_mb()
        self._rows.append((index, *times, math.nan if memory_mb is None else memory_mb))

    def costs(self) -> FrameCosts:
        """Return the costs of all frames."""
        rows = np.array(self._rows, np.float64).reshape(-1, 3 + len(COLUMNS))
        frames, total_ms, *columns_ms, memory_mb = rows.T
        by_column = dict(zip(COLUMNS, columns_ms, strict=True))
        return FrameCosts(frames.astype(np.int64), total_ms, by_column, memory_mb)

    def _new_ms(self, stages: Sequence[str]) -> float:
        total_ms = 0.0
        for stage in stages:
            durations = self.recorder.durations_ms.get(stage, [])
            total_ms += sum(durations[self._known.get(stage, 0) :])
            self._known[stage] = len(durations)
        return total_ms


def time_chart(costs: FrameCosts) -> Markup:
    """Draw the time of each frame; empty without frames."""
    if not len(costs.frames):
        return Markup()
    highest_ms = _RANGE_FACTOR * float(np.percentile(costs.total_ms, _RANGE_PERCENTILE))
    above = costs.frames[costs.total_ms > highest_ms]

    def line(values_ms: NDArray[np.float64], name: str, colour: str) -> Series:
        shown = np.where(values_ms <= highest_ms, values_ms, np.nan)
        return Series(_points(costs.frames, shown), name, colour)

    mapping_ms = costs.columns_ms[Column.LABELLING] + costs.columns_ms[Column.MAPPING]
    mapping = line(mapping_ms, "mapping of keyframes", "second")
    # Frames between keyframes are not mapped; the line connects the keyframes.
    mapped = replace(mapping, points=mapping.points[~(mapping.points[:, 1] == 0.0)])
    series = [
        line(costs.total_ms, "all", "truth"),
        mapped,
        line(costs.columns_ms[Column.TRACKING], "tracking", "estimate"),
    ]
    axes = Axes(
        _x_label(len(costs.frames)),
        "time, ms",
        marks_x=[float(frame) for frame in above],
        marks_name=f"longer, up to {costs.total_ms.max():.0f} ms",
    )
    return line_chart(series, axes)


def memory_chart(costs: FrameCosts) -> Markup:
    """Draw the resident memory of the process; empty if it is unknown."""
    points = _points(costs.frames, costs.memory_mb)
    return line_chart([Series(points, "", "estimate")], Axes(_x_label(len(costs.frames)), "MB"))


def _group(count: int) -> int:
    return max(1, math.ceil(count / _MAX_POINTS))


def _x_label(count: int) -> str:
    group = _group(count)
    return "frame" if group == 1 else f"frame (largest value of every {group} frames)"


def _points(frames: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points [N, 2]: the largest finite value of each group of frames, nan without one."""
    starts = np.arange(0, len(frames), _group(len(frames)))
    if not len(starts):
        return np.empty((0, 2))
    largest = np.fmax.reduceat(values, starts)
    return np.stack([frames[starts].astype(np.float64), largest], axis=1)


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process in MB (10^6 bytes).

    On Linux, it is read from `VmHWM`: `getrusage` may report the memory of the parent process
    from which this one was forked.
    """
    if _STATUS.exists():
        for line in _STATUS.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    bytes_per_unit = 1 if sys.platform == "darwin" else 1024
    return peak * bytes_per_unit / 1e6


def resident_memory_mb() -> float | None:
    """Return the present resident memory of this process in MB, None where it is unknown."""
    try:
        pages = int(_STATM.read_text(encoding="utf-8").split()[1])
    except OSError:
        return None
    return pages * resource.getpagesize() / 1e6


def gaussian_bytes(feature_channels: int) -> int:
    """Return the size of one Gaussian's float32 parameters, in bytes."""
    return _FLOAT_BYTES * (_GEOMETRY_FLOATS + feature_channels)
