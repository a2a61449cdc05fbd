"""Maps of semsplat and of OpenSplat from the same keyframes and poses, at equal effort.

    taskset -c 1 env OMP_NUM_THREADS=1 SEMSPLAT_DATA=DATA \\
        python -m benchmarks.trainers --opensplat PATH [--only NAMES]

OpenSplat is a program of its own and no part of this project: build it for the CPU from
https://github.com/pierotofy/OpenSplat, and give its path here or in OPENSPLAT. The maps and
pictures of near views remain in `runs/benchmarks/trainers`.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.recordings import sequence_arguments
from benchmarks.report import WORK, Report, ReportOptions
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table
from benchmarks.trainer_runs import (
    REFINE_STEPS,
    OpenSplat,
    our_map,
    refined_map,
    trainer_input,
)
from benchmarks.trainer_scores import Look, near_views, scores, trained_look
from toolkit.io.images import write_png
from toolkit.runs.maps.finished import load_run

VARIABLE = "OPENSPLAT"
UNSEEN, CPU = "unseen psnr db", "cpu s"
COLUMNS = (UNSEEN, "unseen ssim", "gaussians", "mb", CPU, "steps")
SHAPES = ("spheres", "ellipsoids")
REFINED = "ellipsoids, refined"
EQUAL, HALF, LONG = "OpenSplat, equal CPU time", "OpenSplat, long, half-way", "OpenSplat, long"
METHODS = (*SHAPES, REFINED, EQUAL, HALF, LONG)
POINTS = 30_000


@dataclass(frozen=True)
class Case:
    """A recording.

    Attributes:
        sequence: its name in `benchmarks.recordings`.
        options: further options of `semsplat run`, which choose the frames.
        real: a real sensor, whose exposure varies: a gain and a bias are fitted to each view.
        patience: CPU seconds of OpenSplat's long run as a multiple of `--long-s`.
    """

    sequence: str
    options: tuple[str, ...]
    real: bool = False
    patience: float = 1.0

    @property
    def row(self) -> list[str]:
        """Name of the sequence, and options of `semsplat run`."""
        return [self.sequence, *self.options, "--poses", "given"]


_SIXTY, _SMALL = ("--max-frames", "60"), ("--image-size", "160", "120")
_PATIENCE = 5.0
CASES = {
    "office0 300x170": Case("office0", ("--image-size", "300", "170")),
    "room 320x240": Case("room", _SIXTY),
    "RedKitchen 320x240": Case("redkitchen", _SIXTY, real=True),
    # Small enough for the trainer to converge.
    "office0 150x85": Case("office0", ("--image-size", "150", "85"), patience=_PATIENCE),
    "room 160x120": Case("room", (*_SIXTY, *_SMALL), patience=_PATIENCE),
    "RedKitchen 160x120": Case("redkitchen", (*_SIXTY, *_SMALL), real=True, patience=_PATIENCE),
}
DESCRIPTION = f"""\
Every fifth frame is held out from both programs, and the poses are the recording's. `semsplat
run` without semantics, otherwise default settings, with each `--mapping.final-shape`; "refined"
is the same map after `semsplat refine --iterations {REFINE_STEPS}`. CPU seconds are those of the
whole processes, start and evaluation included. OpenSplat (CPU build) gets the keyframes of our
map, the same poses and {POINTS // 1000} k points of their depth images, and is run in the input's
frame and at full resolution from the first step (`--num-downscales 0`), otherwise with its
default settings. "Equal CPU time" has as many steps as fit into the CPU time of our slower map,
"long" as many as fit into `--long-s` CPU seconds, {_PATIENCE:g} times as many for the small
images, on which it comes near convergence; both are estimated from two short runs, and the
learning rates of each run end with it. The map half-way through the long run shows how far that
run is from convergence.

The splat files of both are read and rendered at the poses of the held-out frames by the same
code; MB are those of the files (OpenSplat's hold third-degree harmonics). On the real recording a
gain and a bias are fitted to each view. OpenSplat's maps are rendered as its CPU code sees them
while it trains: with the principal point in the centre of the image, and before its background,
without which maps that are not yet opaque have wrong colours.

The build measured has the code of version 1.1.4. It reads the depths that it sorts by from a
strided tensor as if they were contiguous; with libtorch 2.13 its Gaussians were blended in a
wrong order, and 500 steps on office0 reached 27 dB instead of 34 dB. The tensor was made
contiguous, as OpenSplat's later code does. That later code also has other learning rates and
another way to add Gaussians, and has not been measured. OpenSplat's default of 30 000 steps is
far beyond these budgets.

Near views of office0, at 90 CPU seconds: [trainers.png](../../docs/images/trainers.png)."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Compare maps with OpenSplat's."""

    opensplat: Path | None = None
    """OpenSplat's program; by default the variable OPENSPLAT."""
    long_s: float = 90.0
    """CPU seconds of OpenSplat's long run on each recording."""


def main() -> None:
    """Measure one recording after the other."""
    options = tyro.cli(Options)
    program = program_path(options.opensplat, os.environ)
    report = Report("trainers", "Trainers at equal effort", DESCRIPTION, options)
    jobs = {name: [name, options.long_s * case.patience] for name, case in CASES.items()}
    found = report.measured(jobs, lambda job, seed: measure(job, seed, OpenSplat(program)))
    rows = rows_of(found)
    table = table_of(COLUMNS, rows, "recording, map")
    report.write(table, target_table(targets(rows)))


def program_path(given: Path | None, variables: Mapping[str, str]) -> Path:
    """OpenSplat's program.

    Raises:
        SystemExit: it is not given or cannot be executed.
    """
    path = given or (Path(variables[VARIABLE]) if variables.get(VARIABLE) else None)
    if path is None:
        raise SystemExit(
            f"give OpenSplat's program with --opensplat PATH or the variable {VARIABLE}; build it "
            "for the CPU from https://github.com/pierotofy/OpenSplat"
        )
    if not os.access(path, os.X_OK) or path.is_dir():
        raise SystemExit(f"--opensplat: {path} is not a program")
    return path.resolve()


def measure(job: list[Any], seed: int, trainer: OpenSplat) -> dict[str, Metrics]:
    """The metrics of each map of a recording, by method."""
    name, long_s = job
    case = CASES[name]
    folder = WORK / "trainers" / file_name(name)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    sequence, *options = case.row
    arguments = [*sequence_arguments(sequence), *options]
    effort: dict[str, Metrics] = {
        shape: {CPU: our_map(arguments, shape, seed, folder / shape)} for shape in SHAPES
    }
    own_s = effort["ellipsoids"][CPU] + refined_map(folder / "ellipsoids", folder / "refined")
    effort[REFINED] = {CPU: own_s}
    runs = {shape: load_run(folder / shape) for shape in SHAPES}
    runs[REFINED] = load_run(folder / "refined")
    maps = {method: run.folder.map for method, run in runs.items()}
    run = runs[SHAPES[0]]
    project = trainer_input(run, folder / "project", POINTS, seed)
    budgets = {EQUAL: max(effort[shape][CPU] for shape in SHAPES), LONG: long_s}
    for method, cpu_s in budgets.items():
        maps[method] = folder / f"{file_name(method)}.ply"
        steps = trainer.steps(project, folder / "trial.ply", cpu_s)
        half = steps // 2 if method == LONG else None
        effort[method] = {CPU: trainer.train(project, maps[method], steps, half), "steps": steps}
        if half:
            maps[HALF] = maps[method].with_name(f"{maps[method].stem}_{half}.ply")
            effort[HALF] = {"steps": half}
    looks = {
        method: Look(run.camera) if method in runs else trained_look(run.camera) for method in maps
    }
    shown = {method: path for method, path in maps.items() if method != HALF}
    write_png(folder / "near.png", near_views(run, shown, looks))
    return {
        method: scores(runs.get(method, run), maps[method], looks[method], case.real)
        | effort[method]
        for method in METHODS
        if method in maps
    }


def file_name(text: str) -> str:
    """The name of a row as that of a file."""
    return "-".join(text.replace(",", "").split())


def rows_of(found: Rows) -> Rows:
    """One row for each map: the metrics of recordings hold those of their maps by method."""
    return {
        f"{name}, {method}": [run[method] for run in runs]
        for name, runs in found.items()
        for method in METHODS
        if all(method in run for run in runs)
    }


def targets(rows: Rows) -> list[Target]:
    """What our maps of ellipsoids should reach beside OpenSplat's."""
    median = median_of(rows)
    found = []
    for name in CASES:
        for own, method in ((SHAPES[-1], EQUAL), (REFINED, LONG)):
            ours, theirs = median(f"{name}, {own}", UNSEEN), median(f"{name}, {method}", UNSEEN)
            gain = None if ours is None or theirs is None else ours - theirs
            label = f"{name}, unseen PSNR of {own} beside {method}, dB more"
            found.append(Target(label, gain, at_least=0.0))
    return found


if __name__ == "__main__":
    main()
