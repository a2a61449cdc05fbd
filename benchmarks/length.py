"""What a longer sequence costs: memory, and time per frame from the first quarter to the last.

    python -m benchmarks.length [--poses given]

Compares three rooms with twelve. Each run is a process of its own, fusion and export included, with
a small memory budget for inactive submaps so that both exceed it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.recordings import room
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_slam
from benchmarks.tables import Metrics, Target, median_of, table_of, target_table
from toolkit.datasets.registry import open_dataset
from toolkit.options import validated
from toolkit.runs.settings import RunSettings

COLUMNS = (
    "ms per frame, quarters",
    "finish_s",
    "submaps",
    "frames.lost",
    "map.gaussians",
    "memory.peak_mb",
)
ROWS = {"3 rooms, 600 frames": "rooms", "12 rooms, 2400 frames": "hall"}
DESCRIPTION = """\
Three rooms on a corridor and twelve (`semsplat make-room --layout rooms --frames 600` and
`--layout hall --frames 2400`, both with `--image-size 160 120 --sensor-noise`), with
`--mapping.iterations 3 --mapping.final-iterations 1 --submaps.memory-mb 50`. Times are means over
the four quarters of the sequence."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Process a short and a long sequence."""

    poses: Literal["slam", "given"] = "slam"
    """Track, or use the true poses."""
    child: str = ""
    """Settings of one run as JSON; used by the program itself."""


def main() -> None:
    """Measure one row for each sequence."""
    options = tyro.cli(Options)
    if options.child:
        print(json.dumps(measure_here(json.loads(options.child))))
        return
    given = options.poses == "given"
    report = Report(
        f"length{'-given-poses' if given else ''}",
        f"Longer sequences{', poses given' if given else ''}",
        DESCRIPTION,
        options,
    )
    jobs = {name: {"room": place, "poses": options.poses} for name, place in ROWS.items()}
    rows = report.measured(jobs, measure)
    short, long = (median_of(rows)(name, "memory.peak_mb") for name in ROWS)
    growth = long / short if short and long else None
    target = Target("memory of four times the length, ratio", growth, at_most=1.3)
    report.write(table_of(COLUMNS, rows), target_table([target]))


def measure(job: dict[str, str], _seed: int) -> Metrics:
    """Run one sequence in a process of its own, so that peak memory is its own."""
    room(job["room"])
    command = [sys.executable, "-m", "benchmarks.length", "--child", json.dumps(job)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    metrics: Metrics = json.loads(done.stdout.splitlines()[-1])
    return metrics


def measure_here(job: dict[str, Any]) -> Metrics:
    """Run one sequence in this process."""
    place = room(job["room"])
    settings = validated(
        RunSettings,
        {
            "dataset": {"kind": "synthetic", "path": str(place)},
            "poses": job["poses"],
            "mapping": {"iterations": 3, "final_iterations": 1},
            "submaps": {"memory_mb": 50.0},
        },
    )
    with finished_slam(settings, open_dataset("synthetic", place)) as run:
        quarters = [float(np.mean(part)) for part in np.array_split(run.frames_ms, 4)]
        return run.metrics | {
            COLUMNS[0]: ", ".join(f"{ms:.0f}" for ms in quarters),
            "finish_s": run.finish_s,
            "submaps": len(run.result.submaps),
        }


if __name__ == "__main__":
    main()
