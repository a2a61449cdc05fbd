"""What a longer sequence costs: memory, disk, and time per frame from first to last quarter.

    python -m benchmarks.length [--poses given]

Compares three rooms with twelve, twelve seen once with the same seen fifteen times, a kitchen seen
once with the same seen ten and sixty times, and one room in which the camera moves freely for 155 s
and for 310 s.
Each run is a process of its own, fusion and export included. Three and twelve rooms have a small
memory budget for inactive submaps, so that both exceed it.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.recordings import RECORDINGS, room
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_slam
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table
from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.options import validated
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.settings import RunSettings

COLUMNS = (
    "ms per frame, quarters",
    "MB resident, quarters",
    "finish_s",
    "evaluation_s",
    "frames.keyframes",
    "submaps",
    "loops.searched",
    "frames.lost",
    "trajectory.ate_rmse_cm",
    "map.gaussians",
    "memory.peak_mb",
    "results_mb",
)
_ROOMS = {"mapping": {"iterations": 3, "final_iterations": 1}, "submaps": {"memory_mb": 50.0}}
ROWS: dict[str, dict[str, Any]] = {
    "3 rooms, 600 frames": {"room": "rooms", "settings": _ROOMS},
    "12 rooms, 2400 frames": {"room": "hall", "settings": _ROOMS},
    "12 rooms, 36000 frames": {"room": "hall", "laps": 15, "settings": _ROOMS},
    "free motion, 4650 frames": {"room": "long", "frames": 4650},
    "free motion, 9300 frames": {"room": "long"},
    "kitchen, 600 frames": {"laps": 1},
    "kitchen, 6000 frames": {"laps": 10},
    "kitchen, 640x480, 600 frames": {"laps": 1, "size": [640, 480]},
    "kitchen, 640x480, 36000 frames": {"laps": 60, "size": [640, 480]},
}
_PAIRS = {
    "more rooms": ("3 rooms, 600 frames", "12 rooms, 2400 frames"),
    "the same twelve rooms": ("12 rooms, 2400 frames", "12 rooms, 36000 frames"),
    "the same room": ("free motion, 4650 frames", "free motion, 9300 frames"),
    "the same kitchen": ("kitchen, 600 frames", "kitchen, 6000 frames"),
    "the same kitchen for 20 minutes": (
        "kitchen, 640x480, 600 frames",
        "kitchen, 640x480, 36000 frames",
    ),
}
_LIMITS = {"memory.peak_mb": 1.3, "frames.keyframes": 1.5, "submaps": 1.5, "results_mb": 1.5}
_DRAWN = 60  # points of each line of the picture
_GROWING = (
    *("frames.keyframes", "map.gaussians", "submaps", "loops.searched", "memory.peak_mb"),
    *("results_mb", "finish_s", "evaluation_s"),
)
DESCRIPTION = """\
Three rooms on a corridor and twelve (`semsplat make-room --layout rooms --frames 600` and
`--layout hall --frames 2400`, both with `--image-size 160 120 --sensor-noise`), with
`--mapping.iterations 3 --mapping.final-iterations 1 --submaps.memory-mb 50`; the twelve also
forwards and backwards in turn, fifteen times: 20 minutes at 30 frames per second. One room
through which the camera moves freely (`--layout long --image-size 160 120 --sensor-noise`), and
the first 600 frames of 7-Scenes RedKitchen at 320x240 once, and forwards and backwards in turn,
ten times, with default settings; at 640x480, sixty times: again 20 minutes. Times are means over
the four quarters of the sequence; memory is that of the process at their ends. Results: the run
folder. The picture shows both along the sequences."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Process short and long sequences."""

    poses: Literal["slam", "given"] = "slam"
    """Track, or use the true poses."""
    child: str = ""
    """Settings of one run as JSON; used by the program itself."""


class BackAndForth:
    """A recording forwards and backwards in turn, as one sequence.

    Args:
        laps: number of times that the recording is passed.
    """

    def __init__(self, dataset: RecordedDataset, laps: int) -> None:
        self._dataset, count = dataset, len(dataset)
        there, back = range(count), range(count - 1, -1, -1)
        self._order = [index for lap in range(laps) for index in (back if lap % 2 else there)]

    def __len__(self) -> int:
        return len(self._order)

    def __getitem__(self, index: int) -> Frame:
        frame = self._dataset[self._order[index]]
        return replace(frame, index=index, timestamp_s=float(self.timestamps_s[index]))

    @cached_property
    def timestamps_s(self) -> NDArray[np.float64]:
        """[N] times at the rate of the recording."""
        times_s = self._dataset.timestamps_s
        return np.asarray(np.arange(len(self)) * float(np.median(np.diff(times_s))))

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """The true poses in the order of the frames."""
        truth = self._dataset.ground_truth
        if truth is None:
            return None
        poses = [truth.at(self._dataset.timestamps_s[index]) for index in self._order]
        known = [k for k, T in enumerate(poses) if T is not None]
        return Trajectory(self.timestamps_s[known], np.array([poses[k] for k in known]))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dataset, name)


def main() -> None:
    """Measure one row for each sequence."""
    options = tyro.cli(Options)
    if options.child:
        print(json.dumps(measure_here(json.loads(options.child))))
        return
    given = options.poses == "given"
    name = f"length{'-given-poses' if given else ''}"
    report = Report(
        name,
        f"Longer sequences{', poses given' if given else ''}",
        DESCRIPTION,
        options,
    )
    jobs = {name: row | {"poses": options.poses} for name, row in ROWS.items()}
    rows = report.measured(jobs, measure)
    median = median_of(rows)

    def ratio(long: str, short: str, metric: str) -> float | None:
        numerator, denominator = median(long, metric), median(short, metric)
        return numerator / denominator if numerator and denominator else None

    targets = [
        Target(
            f"{what}: {metric}, ratio of the long to the short one",
            ratio(long, short, metric),
            at_most=at_most,
        )
        for what, (short, long) in _PAIRS.items()
        for metric, at_most in _LIMITS.items()
        if what != "more rooms" or metric == "memory.peak_mb"
    ]
    growth = {what: _exponents(ratio, *pair) for what, pair in _PAIRS.items()}
    if all(rows.get(name) for name in ROWS):
        draw(rows, options.out / f"{name}.svg")
    report.write(
        table_of(COLUMNS, rows),
        target_table(targets),
        replace(
            table_of(_GROWING, {what: [exponents] for what, exponents in growth.items()}),
            title="Exponents of the number of frames",
        ),
    )


def _exponents(ratio: Callable[[str, str, str], float | None], short: str, long: str) -> Metrics:
    """Exponents of the growth from the short to the long sequence; 1 is proportional."""
    frames = ratio(long, short, "frames.total")
    grown = {metric: ratio(long, short, metric) for metric in _GROWING}
    return {
        metric: math.log(factor) / math.log(frames)
        for metric, factor in grown.items()
        if factor and frames and frames > 1
    }


def measure(job: dict[str, Any], _seed: int) -> Metrics:
    """Run one sequence in a process of its own, so that peak memory is its own."""
    if "room" in job:
        room(job["room"])
    command = [sys.executable, "-m", "benchmarks.length", "--child", json.dumps(job)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    metrics: Metrics = json.loads(done.stdout.splitlines()[-1])
    return metrics


def measure_here(job: dict[str, Any]) -> Metrics:
    """Run one sequence in this process."""
    settings, dataset = _opened(job)
    with finished_slam(settings, dataset) as run:
        done_s = time.perf_counter()
        return run.metrics | {
            "ms per frame, quarters": _parts(run.frames_ms, np.mean, 4),
            "MB resident, quarters": _parts(run.memory_mb, lambda part: part[-1], 4),
            "ms per frame, parts": _parts(run.frames_ms, np.mean, _DRAWN),
            "MB resident, parts": _parts(run.memory_mb, lambda part: part[-1], _DRAWN),
            "finish_s": run.finish_s,
            "evaluation_s": done_s - run.finished_at_s,
            "submaps": len(run.result.submaps),
            "results_mb": run.results_mb,
        }


def _opened(job: dict[str, Any]) -> tuple[RunSettings, Dataset]:
    """Settings and frames of one run."""
    if "room" in job:
        kind, path, size = "synthetic", room(job["room"]), None
    else:
        kitchen = RECORDINGS["redkitchen_30fps"]
        kind, path = kitchen.kind, kitchen.path
        size = tuple(job["size"]) if "size" in job else kitchen.image_size
    given = {"dataset": {"kind": kind, "path": str(path)}, "poses": job["poses"]}
    if size is not None:
        given |= {"image_size": list(size)}
    settings = validated(RunSettings, given | job.get("settings", {}))
    recorded = open_dataset(kind, path, size)
    dataset: Any = BackAndForth(recorded, job["laps"]) if "laps" in job else recorded
    if "frames" in job:
        dataset = RecordedDataset(recorded.recording, size, job["frames"])
    return settings, dataset


def _parts(values: Sequence[float], summary: Any, count: int) -> str:
    parts = np.array_split(np.array(values), count)
    return ", ".join(f"{float(summary(part)):.0f}" for part in parts)


def draw(rows: Rows, path: Path) -> None:
    """Draw the time per frame and the memory along the sequences, one line each."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams["svg.hashsalt"] = "length"
    figure = Figure(figsize=(10, 7), layout="constrained")
    for axes, (column, label) in zip(
        figure.subplots(2, 1, sharex=True),
        (("ms per frame, parts", "ms per frame"), ("MB resident, parts", "resident memory, MB")),
        strict=True,
    ):
        for name, (run, *_) in rows.items():
            values = [float(value) for value in str(run[column]).split(", ")]
            frames = np.arange(1, len(values) + 1) * (float(run["frames.total"]) / len(values))
            axes.plot(frames, values, label=name if column.startswith("ms") else None)
        axes.set(xscale="log", ylabel=label, ylim=(0, None))
        axes.grid(visible=True, alpha=0.3)
    axes.set_xlabel("frames")
    figure.legend(loc="outside upper center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
