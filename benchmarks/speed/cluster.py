"""Many runs and the refinement of one map on one and on two workers.

    python -m benchmarks.speed.cluster

Run it on an otherwise idle machine with two cores, where it takes about ten minutes. A few frames
show whether it works: --runs 2 --frames 10 --map-frames 120 --submap-keyframes 12.
Requires `pip install 'semsplat[cluster]'`.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import TypeVar

import tyro
import yaml

from benchmarks.shared.programs import semsplat, start_semsplat
from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.runner import publish
from benchmarks.shared.tables import Table
from toolkit.runs.batch.refining.pipeline import refine_map
from toolkit.runs.settings import PresetName

Item = TypeVar("Item")
Value = TypeVar("Value")

DESCRIPTION = """\
`semsplat run-many` executes runs of a walk along a ring of rooms (160x120, sensor noise; the first
frames) with different seeds on a Ray cluster of this machine, one thread each. Times include the
start of the cluster, the imports of each process, and the report. `semsplat refine` refines the map
of a walk through twelve rooms along corridors (120x90, sensor noise, 1500 frames unless the command
specifies fewer). `trajectory.txt`, `map.ply` and `loops.jsonl` of runs, and all files of refined
maps, are compared byte by byte. Times of tasks are those of one process on one thread."""

SAME = ("trajectory.txt", "map.ply", "loops.jsonl")
WORKERS = (1, 2)


@dataclass(frozen=True)
class Options:
    """Measure many runs and refinement on one and two workers."""

    runs: int = 4
    """Number of runs of the plan."""
    frames: int = 40
    """Frames of each run."""
    map_frames: int = 1500
    """Frames of the run whose map is refined; all of them for the map of twelve rooms."""
    submap_keyframes: int | None = None
    """Maximum number of keyframes of its submaps. By default, that of the settings."""
    preset: PresetName = "fast"
    """Settings of all runs."""
    out: Path = RESULTS
    """Folder of the results file."""


def main() -> int:
    """Measure; exit with 1 if any result differs."""
    options = tyro.cli(Options)
    header = current_header(range(options.runs), ("toolkit",), threads="1")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        runs, run_s = measure_runs(options, folder)
        refinements, times_s = measure_refinement(options, folder)
    tables = (runs, refinements, task_table(options.frames, run_s, times_s))
    publish(Results("cluster", "Runs on a cluster", DESCRIPTION, header, tables), options.out)
    return (
        1 if any("differs" in cell for row in runs.rows + refinements.rows for cell in row) else 0
    )


def measure_runs(options: Options, folder: Path) -> tuple[Table, float]:
    """Execute the plan on one and two workers; mean time of a run (s)."""
    rows, times, whole = [], {}, folder / "workers1"
    for workers in WORKERS:
        plan = _plan(options, folder / f"workers{workers}.yaml")
        begin = time.monotonic()
        start_semsplat("run-many", str(plan), "--ray.cpus", str(workers)).wait()
        times[workers] = time.monotonic() - begin
        verdict = _compared(whole, folder / plan.stem, options.runs) if workers > 1 else "-"
        rows.append(_row(f"{workers} worker(s)", times[workers], times[1], plan, options, verdict))
    titles = ("runs", "time, s", "speed-up", "finished", "processes started", "results")
    run_s = fmean(_run_times(whole))
    return Table(titles, tuple(rows), "Many runs"), run_s


def _row(
    name: str, time_s: float, one_s: float, plan: Path, options: Options, verdict: str
) -> tuple[str, ...]:
    out = plan.with_suffix("")
    lines = [len(p.read_text().splitlines()) for p in (out / "logs").rglob("*.attempts.jsonl")]
    finished = len(list(out.rglob("seed*/report.html")))
    done = f"{finished} of {options.runs}"
    return (name, f"{time_s:.0f}", f"{one_s / time_s:.2f}", done, str(sum(lines)), verdict)


def _plan(options: Options, path: Path) -> Path:
    room = sequence_arguments("ring-small")
    place = {"kind": "synthetic", "path": room[room.index("--dataset.path") + 1]}
    place["path"] = str(Path(place["path"]).absolute())
    content = {
        "sequences": {"ring": {"dataset": place, "options": {"max_frames": options.frames}}},
        "settings": {
            "default": {"preset": options.preset, "options": {"checkpoint": {"every_keyframes": 1}}}
        },
        "seeds": list(range(options.runs)),
        "resources": {"threads": 1, "memory_gb": 1.5},
    }
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def _compared(whole: Path, other: Path, runs: int) -> str:
    different = [
        f"{name} of seed {seed}"
        for seed in range(runs)
        for name in SAME
        if (whole / f"ring/default/seed{seed}" / name).read_bytes()
        != (other / f"ring/default/seed{seed}" / name).read_bytes()
    ]
    return f"**differs** in {', '.join(different)}" if different else "identical"


def _run_times(out: Path) -> list[float]:
    times = []
    for path in out.glob("ring/default/*/metrics.json"):
        metrics = json.loads(path.read_text())
        times.append(metrics["time"]["total_ms_per_frame"] * metrics["frames"]["total"] / 1000.0)
    return times


class TimedTasks:
    """Calls functions in this process, and records the time of each call by function name."""

    def __init__(self) -> None:
        self.times_s: dict[str, list[float]] = {}

    def map(self, function: Callable[[Item], Value], items: Sequence[Item]) -> list[Value]:
        """See Tasks."""
        values = []
        for item in items:
            begin = time.monotonic()
            values.append(function(item))
            taken = time.monotonic() - begin
            self.times_s.setdefault(getattr(function, "__name__", ""), []).append(taken)
        return values


def measure_refinement(
    options: Options, folder: Path
) -> tuple[Table, Mapping[str, Sequence[float]]]:
    """Refine one map in this process and on one and two workers; times of its tasks."""
    run = folder / "map"
    allocation = []
    if options.submap_keyframes is not None:
        allocation = [
            *("--submaps.allocation.max-keyframes", str(options.submap_keyframes)),
            *("--submaps.allocation.min-keyframes", str(max(2, options.submap_keyframes // 2))),
        ]
    sequence = sequence_arguments("hall-fast")
    frames = ["--preset", options.preset, "--max-frames", str(options.map_frames)]
    semsplat("run", *sequence, *allocation, *frames, "--out", str(run))
    timed = TimedTasks()
    begin = time.monotonic()
    refined = refine_map(str(run), str(folder / "here"), timed)
    rows = [("this process", f"{time.monotonic() - begin:.0f}", "-", "-")]
    one_s = 0.0
    for workers in WORKERS:
        out = folder / f"refined{workers}"
        begin = time.monotonic()
        semsplat("refine", str(run), "--out", str(out), "--ray.cpus", str(workers))
        taken = time.monotonic() - begin
        one_s = one_s or taken
        verdict = "identical" if _same_folder(folder / "here", out) else "**differs**"
        rows.append((f"{workers} worker(s)", f"{taken:.0f}", f"{one_s / taken:.2f}", verdict))
    title = (
        f"Refinement of a map of {options.map_frames} frames, {refined.submaps} submaps and "
        f"{refined.pairs} pairs"
    )
    titles = ("refinement", "time, s", "speed-up", "result")
    return Table(titles, tuple(rows), title), timed.times_s


def _same_folder(one: Path, two: Path) -> bool:
    names = [sorted(p.relative_to(r) for p in r.rglob("*") if p.is_file()) for r in (one, two)]
    same = (p for p in names[0] if (one / p).read_bytes() == (two / p).read_bytes())
    return names[0] == names[1] and list(same) == names[0]


def task_table(frames: int, run_s: float, times_s: Mapping[str, Sequence[float]]) -> Table:
    """Measured times of all tasks."""
    rows = [(f"run of {frames} frames", "-", f"{run_s:.2f}")]
    rows += [(n, str(len(t)), f"{fmean(t):.3f}") for n, t in times_s.items()]
    return Table(("task", "tasks", "mean time, s"), tuple(rows), "Times of tasks")


if __name__ == "__main__":
    sys.exit(main())
