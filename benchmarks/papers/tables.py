"""Counterparts of the tables of both papers, by one command.

    SEMSPLAT_DATA=DATA python -m benchmarks.papers.tables [--quick]

Writes results/tables.md (quick: tables-quick.md; some groups: tables-GROUP.md). An interrupted call
continues when repeated.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.papers.definitions import COLUMNS, TABLES, PaperTable
from benchmarks.papers.plans import GROUPS
from benchmarks.papers.runs import Effort, PaperRuns
from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.runner import publish
from benchmarks.shared.tables import MISSING, Metrics, Table

DESCRIPTION = """\
The counterpart of each table of Hier-SLAM++ (H) and GauSem-SLAM (G), measured by one command. Cells
are means over sequences and seeds, ± the standard deviation where there are several runs. The
column "paper" has the published value; it was measured on other data, and mostly by another
protocol, so that only the order of rows can be compared. Settings: `hier-slam` and `gausem` are the
papers' systems as printed, with the deviations of docs/reference/presets.md; `default` and `best`
are ours. office0 is Replica's (of 51 views, 9 cm and 6 degrees apart, which 40 steps of Adam cannot
track: its poses are given) at 160x90, the room is synthetic (`semsplat make-room`), real sequences
are at 160x120 (HoloLens at 180x120), rings are synthetic (four rooms, 450 frames, sensor noise) at
160x120. ATE after SE(3) alignment; images of mapped views; depth L1 where rendered and measured;
mIoU of all classes of the truth. LPIPS needs weights (`--lpips-weights`) and is left out. Times are
of one thread with another process on the second core.

Not here: ScanNet, TUM fr1/desk, fr1/room, fr2/xyz and fr3/office, and seven of eight Replica scenes
are not on this machine. H-VII (codes) is in `semantics-quality.md`, H-IX (trees) in
`trees-room.md` and `many-classes.md`, registration in `registration-redkitchen.md`; other systems
are in `open3d-*.md` and `motion.md`. docs/papers.md has tracking on depth priors (H-16) and G-VI
(registration) as they were measured at earlier commits."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure the counterparts of the papers' tables."""

    groups: tuple[str, ...] = tuple(GROUPS)
    """Plans to execute; a page of its own for some of them, with the tables that they complete."""
    quick: bool = False
    """The first sequence of each plan, 12 frames and one seed: a daily check in 15 minutes."""
    seeds: int = 5
    """Maximum number of seeds, of rooms too; a later call can add the others."""
    processes: int = 2
    """Number of plans that are executed at the same time, one thread each."""
    out: Path = RESULTS
    """Folder of the results file."""


def main() -> None:
    """Execute the plans and write the tables."""
    options = tyro.cli(Options)
    header = current_header(range(5))
    begin = time.perf_counter()
    seeds = 1 if options.quick else options.seeds
    runs = PaperRuns(GROUPS, Effort(options.quick, seeds))
    runs.execute(options.groups, options.processes)
    name, title = "tables", "The papers' tables"
    if options.quick:
        name, title = f"{name}-quick", f"{title}, quick check"
    chosen = TABLES
    if set(options.groups) != set(GROUPS):
        name, title = f"{name}-{options.groups[0]}", f"{title}: {', '.join(options.groups)}"
        chosen = tuple(
            t for t in TABLES if {row.group for row in t.rows.values()} <= set(options.groups)
        )
    tables = [run_table(table, runs) for table in chosen]
    print(f"{(time.perf_counter() - begin) / 60:.0f} minutes")
    publish(Results(name, title, DESCRIPTION, header, tuple(tables)), options.out)


def run_table(table: PaperTable, runs: PaperRuns) -> Table:
    """A table of runs; cells of runs that do not exist are n/a."""
    rows, missing = [], 0
    for title, row in table.rows.items():
        found = runs.metrics(row.group, row.settings, row.sequence)
        missing += max(runs.expected(row.group, row.sequence) - len(found), 0)
        cells = [spread_cell(found, COLUMNS[column]) for column in table.columns]
        rows.append((title, str(len(found)), *cells, row.paper))
    note = f"{table.note} {missing} runs are missing." if missing else table.note
    return Table(("", "runs", *table.columns, "paper"), tuple(rows), table.title, note)


def spread_cell(runs: Sequence[Metrics], key: str | Callable[[Metrics], float | None]) -> str:
    """Mean and standard deviation of a metric; n/a if it is missing in a run."""
    values = [run.get(key) if isinstance(key, str) else key(run) for run in runs]
    if not values or any(value is None for value in values):
        return MISSING
    numbers = [float(value) for value in values if value is not None]
    mean = f"{statistics.mean(numbers):.4g}"
    return mean if len(numbers) < 2 else f"{mean} ± {statistics.stdev(numbers):.2g}"


if __name__ == "__main__":
    main()
