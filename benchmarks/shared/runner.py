"""Measures the rows of a page of results, and writes it; interrupted calls can be repeated."""

from __future__ import annotations

import json
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import tyro

from benchmarks.shared.machine import instruction_set, machine_identity
from benchmarks.shared.repository import ROOT, SYSTEM, source_digest
from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.tables import Metrics, Rows, Table, Target, target_table
from benchmarks.stale import update_index

Job = TypeVar("Job")

WORK = ROOT / "runs" / "benchmarks"


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """What is measured and where it is written."""

    only: tuple[str, ...] = ()
    """Names of the rows to measure; all by default. The results file is written once all rows
    have been measured with the same code on the same machine."""
    fresh: bool = False
    """Measure again what earlier calls with the same code have measured."""
    out: Path = RESULTS
    """Folder of the results file."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Options of a `Page`."""

    seeds: int = 1
    """Seeds 0, 1, ... of each row, which is their median."""


@dataclass(frozen=True)
class Page(Generic[Job]):
    """A page of results with a row for each job.

    Attributes:
        name, title, description: as `Results` has them.
        jobs: what each row measures, as JSON values.
        measure: from a job and a seed to metrics, as JSON values.
        tables: of the measured rows.
        targets: what the rows should reach.
        seeds: number of seeds by default.
        measures: the code that the results depend on.
    """

    name: str
    title: str
    description: str
    jobs: Mapping[str, Job]
    measure: Callable[[Job, int], Metrics]
    tables: Callable[[Rows], Sequence[Table]]
    targets: Callable[[Rows], list[Target]] | None = None
    seeds: int = 1
    measures: Sequence[str] = SYSTEM

    def main(self) -> None:
        """Measure the rows that the command line asks for."""
        default = Options(seeds=self.seeds)
        self.write(tyro.cli(Options, default=default, description=self.title))

    def write(self, options: Options) -> None:
        """Measure rows and write the page."""
        text = self.name, self.title, self.description
        report = Report(*text, options, range(options.seeds), measures=self.measures)
        rows = report.measured(self.jobs, self.measure)
        judged = [target_table(self.targets(rows))] if self.targets else []
        report.write(*self.tables(rows), *judged)


class RunStore:
    """Metrics of finished runs in a file, so that an interrupted benchmark can continue.

    Only runs of the same code on the same machine are found.

    Args:
        path: of the file; created when needed.
        fresh: ignore what the file holds.
    """

    def __init__(self, path: Path, fresh: bool = False) -> None:
        self._path = path
        self._code = [source_digest(), machine_identity(), instruction_set()]
        self._known: dict[str, Metrics] = {}
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        for line in [] if fresh else lines:
            try:
                entry = json.loads(line)
            except ValueError:  # the call was interrupted while it wrote this line
                continue
            self._known[json.dumps(entry["key"])] = entry["metrics"]

    def find(self, job: object) -> Metrics | None:
        """The metrics of a run, None if it has not been finished with this code."""
        return self._known.get(json.dumps([self._code, job]))

    def add(self, job: object, metrics: Metrics) -> None:
        """Remember a finished run."""
        key = [self._code, job]
        self._known[json.dumps(key)] = metrics
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"key": key, "metrics": metrics}) + "\n")


class Report:
    """Rows that are measured, and the file of their results; `Page` does for most benchmarks.

    Args:
        name, title, description: as `Results` has them.
        options: what is measured and where it is written.
        seeds: of each row.
        measures: the code that the results depend on.
    """

    def __init__(
        self,
        name: str,
        title: str,
        description: str,
        options: ReportOptions,
        seeds: Sequence[int] = (0,),
        *,
        measures: Sequence[str] = SYSTEM,
    ) -> None:
        # The load average belongs to the time before the benchmark itself causes any.
        self.header = current_header(seeds, measures)
        self._text = name, title, description
        self._options, self._seeds = options, seeds
        self._store = RunStore(WORK / f"{name}.jsonl", options.fresh)
        self._missing: list[str] = []

    def measured(
        self, jobs: Mapping[str, Job], measure: Callable[[Job, int], Metrics]
    ) -> dict[str, list[Metrics]]:
        """The metrics of every seed of those rows that are complete; see `Page`.

        Raises:
            SystemExit: a name of `--only` is unknown.
        """
        unknown = set(self._options.only) - set(jobs)
        if unknown:
            raise SystemExit(f"--only: no row '{min(unknown)}'; rows: {', '.join(jobs)}")
        found: dict[str, list[Metrics]] = {}
        for name, job in jobs.items():
            chosen = not self._options.only or name in self._options.only
            runs = [self._run(name, job, seed, measure if chosen else None) for seed in self._seeds]
            complete = [run for run in runs if run is not None]
            if len(complete) == len(runs):
                found[name] = complete
            else:
                self._missing.append(name)
        return found

    def _run(
        self, name: str, job: Job, seed: int, measure: Callable[[Job, int], Metrics] | None
    ) -> Metrics | None:
        metrics = self._store.find([job, seed])
        if metrics is None and measure is not None:
            begin = time.perf_counter()
            metrics = measure(job, seed)
            self._store.add([job, seed], metrics)
            print(f"{name}, seed {seed}: {time.perf_counter() - begin:.0f} s", flush=True)
        return metrics

    def write(self, *tables: Table) -> None:
        """Print the results, and write their file unless rows are missing."""
        results = Results(*self._text, self.header, tables)
        if self._missing:
            print("\n\n".join(table.markdown() for table in tables))
            names = textwrap.shorten(", ".join(self._missing), 1000, placeholder=" and more")
            print(f"\n{results.name}.md is not written; rows to measure: {names}")
            return
        publish(results, self._options.out)


def publish(results: Results, folder: Path) -> None:
    """Print results and write them into a folder."""
    print("\n" + results.markdown())
    path = results.write(folder)
    if folder.resolve() == RESULTS:
        update_index()
    print(f"wrote {path}", flush=True)
