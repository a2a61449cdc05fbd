"""How long `semsplat run` takes beside other busy processes, by the way in which threads wait.

    SEMSPLAT_DATA=DATA python -m benchmarks.busy_machine

Run it on an otherwise idle machine.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import tyro

from benchmarks.programs import semsplat
from benchmarks.recordings import sequence_arguments
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Table, Target, target_table

DESCRIPTION = """\
`semsplat run` on two cores, beside processes that compute without pause. Time is the wall-clock
time of the loop over all frames and of the refinement, per frame; medians over repeats, which
alternate between all cells of the table. By default, a thread of GNU OpenMP that has finished its
share of a loop checks 300,000 times for the others before it gives its core away."""

# Environment variables of each row.
WAITING = {
    "semsplat's default": {},
    "OpenMP's default": {"GOMP_SPINCOUNT": "300000"},
    "no spinning (OMP_WAIT_POLICY=passive)": {"OMP_WAIT_POLICY": "passive"},
}
LOADS = (0, 1, 2)
# Largest ratios to the idle time beside one and two busy processes, and to the idle time with
# OpenMP's default.
_MAX_RATIOS, _MAX_IDLE = {1: 1.6, 2: 2.2}, 1.03


@dataclass(frozen=True)
class Options:
    """Measure beside busy processes."""

    sequence: str = "redkitchen"
    """Sequence, as in the other benchmarks."""
    frames: int = 40
    """Frames of each run."""
    repeats: int = 3
    """Runs of each cell, of which the median is shown."""
    out: Path = RESULTS
    """Folder of the results file."""


def main() -> int:
    """Measure all cells in turn, and publish their medians."""
    options = tyro.cli(Options)
    header = current_header([0], ("toolkit",))
    times: dict[tuple[str, int], list[float]] = {}
    for _ in range(options.repeats):
        for load in LOADS:
            for row, variables in WAITING.items():
                with busy_processes(load):
                    time_ms = run_time_ms(options, variables)
                times.setdefault((row, load), []).append(time_ms)
                print(f"{row}, {load} busy: {time_ms:.1f} ms", file=sys.stderr)
    medians = {cell: median(values) for cell, values in times.items()}
    tables = (time_table(medians), target_table(targets(medians)))
    title = f"Busy machines, {options.sequence}, {options.frames} frames"
    publish(Results("busy-machine", title, DESCRIPTION, header, tables), options.out)
    return 0


def time_table(medians: dict[tuple[str, int], float]) -> Table:
    """Times per frame, and ratios to the idle time of the same row."""
    titles = [f"{load} busy, ms per frame" for load in LOADS]
    titles += [f"{load} busy, of idle" for load in LOADS[1:]]
    rows = []
    for row in WAITING:
        cells = [medians[row, load] for load in LOADS]
        ratios = [cell / cells[0] for cell in cells[1:]]
        rows.append((row, *(f"{c:.1f}" for c in cells), *(f"{r:.2f}" for r in ratios)))
    return Table(("waiting", *titles), tuple(rows))


def targets(medians: dict[tuple[str, int], float]) -> list[Target]:
    """The time beside busy processes and the price on an idle machine."""
    ours, theirs = (medians[row, 0] for row in list(WAITING)[:2])
    default = next(iter(WAITING))
    found = [
        Target(f"beside {load} busy, of idle", medians[default, load] / ours, at_most=bar)
        for load, bar in _MAX_RATIOS.items()
    ]
    return [*found, Target("idle, of OpenMP's default", ours / theirs, at_most=_MAX_IDLE)]


def run_time_ms(options: Options, variables: dict[str, str]) -> float:
    """Time per frame of one run."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        frames = ["--max-frames", str(options.frames)]
        sequence = sequence_arguments(options.sequence)
        semsplat("run", "--out", str(out), *sequence, *frames, variables=variables)
        metrics = json.loads((out / "metrics.json").read_text())
    return float(metrics["time"]["total_ms_per_frame"])


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Processes that compute until the block ends."""
    with ExitStack() as stack:
        for _ in range(count):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(process.wait)
            stack.callback(process.kill)
        yield


if __name__ == "__main__":
    sys.exit(main())
