"""Damaged and hostile files, given to the reader of every format by an earlier commit and this one.

    python -m benchmarks.hostile_files [--commit 1a8233b1]

Files are made on the spot (`hostile_attempts`) from valid samples of each format
(`hostile_samples`), and read in processes with limits (`hostile_worker`). The earlier commit is
compiled in a temporary folder.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.earlier_commit import earlier_tree
from benchmarks.hostile_samples import AREAS, SAMPLES, Sample
from benchmarks.hostile_worker import MAX_BYTES, MAX_S, message_fault
from benchmarks.programs import semsplat_of
from benchmarks.report import Report, ReportOptions
from benchmarks.repository import ROOT
from benchmarks.tables import Metrics, Table

DESCRIPTION = """\
{crafted} crafted files and {mutated} random changes of valid small ones, with the seed {seed}, read
as users reach the reader of each format, by the commit {commit} (before) and by this one (now). An
attempt passes if the file is read, or refused in one line that names it, within {limit_s:.0f} s and
{limit_gb} GB of memory. A key that is given twice must be refused. One file of each sample is also
given to `semsplat`."""
_NOW = "now"


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Give damaged and hostile files to the readers of an earlier commit and of this one."""

    commit: str = ""
    """The earlier commit, since toolkit has rooms; empty for this one only."""
    crafted: int = 1317
    """Number of crafted files."""
    mutated: int = 1140
    """Number of random changes."""
    seed: int = 0
    """Seed of both."""


def main() -> None:
    """Try all areas, first with this commit."""
    options = tyro.cli(Options)
    names = ("crafted", "mutated", "seed", "commit")
    given = {name: getattr(options, name) for name in names}
    limits = {"limit_s": MAX_S, "limit_gb": MAX_BYTES // 2**30}
    description = DESCRIPTION.format(**given, **limits)
    report = Report("hostile-files", "Damaged and hostile files", description, options)
    commits = {_NOW: ""} | ({"before": options.commit} if options.commit else {})
    jobs = {
        f"{area}, {name}": given | {"area": area, "commit": commit}
        for name, commit in commits.items()
        for area in AREAS
    }
    with ExitStack() as stack:
        workers: dict[str, Worker] = {}

        def measure(job: Any, _: int) -> Metrics:
            commit = job["commit"]
            if commit not in workers:
                tree = stack.enter_context(_tree(commit)) if commit else ROOT
                workers[commit] = stack.enter_context(_worker(tree))
            return _tried(workers[commit], job)

        found = report.measured(jobs, measure)
    rows = {
        area: {name: found[f"{area}, {name}"][0] for name in commits}
        for area in AREAS
        if all(f"{area}, {name}" in found for name in commits)
    }
    report.write(counted(rows), *(by_cause(rows, name) for name in reversed(commits)))


@contextmanager
def _tree(commit: str) -> Iterator[Path]:
    """A tree of an earlier commit with this one's benchmarks.

    Raises:
        SystemExit: its readers have other names than those that the benchmarks import.
    """
    with earlier_tree(commit) as tree:
        if not (tree / "toolkit/datasets/readers").is_dir():
            raise SystemExit(f"--commit: {commit} is older than the rooms of toolkit")
        shutil.rmtree(tree / "benchmarks")
        shutil.copytree(ROOT / "benchmarks", tree / "benchmarks")
        yield tree


class Worker:
    """A process that tries files with the toolkit of a tree."""

    def __init__(self, tree: Path) -> None:
        self.tree = tree
        # -P: the current folder would be searched first for modules.
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "benchmarks.hostile_worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"},
            cwd=tree,
        )

    def outcomes(self, sample: str, crafted: int, mutated: int, seed: int) -> list[Metrics]:
        """The outcomes of the attempts with a sample.

        Raises:
            SystemExit: the process ended.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps([sample, crafted, mutated, seed]) + "\n")
        self._process.stdin.flush()
        found: list[Metrics] = []
        for line in self._process.stdout:
            outcome = json.loads(line.removeprefix("outcome ")) if "outcome " in line else {}
            if outcome is None:
                return found
            found += [outcome] if outcome else []
        raise SystemExit(f"{sample}: the process ended with status {self._process.wait()}")

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


@contextmanager
def _worker(tree: Path) -> Iterator[Worker]:
    worker = Worker(tree)
    try:
        yield worker
    finally:
        worker.close()


def _tried(worker: Worker, job: Any) -> Metrics:
    """Attempts and failures of an area."""
    found: list[Metrics] = []
    total = sum(sample.weight for sample in SAMPLES.values())
    for name, sample in SAMPLES.items():
        if sample.area == job["area"]:
            crafted, mutated = (
                round(job[kind] * sample.weight / total) for kind in ("crafted", "mutated")
            )
            found += worker.outcomes(name, crafted, mutated, job["seed"])
            found += _by_command(worker.tree, name, sample)
    failed = [outcome for outcome in found if outcome["fault"]]
    return {
        "attempts": len(found),
        "failures": failed,
        "longest_s": max(outcome["seconds"] for outcome in found),
        "largest_mb": max(outcome["memory_mb"] for outcome in found),
    }


def _by_command(tree: Path, name: str, sample: Sample) -> list[Metrics]:
    """The outcome of a job in a process that is given a file of zeros instead of the largest."""
    if not sample.command:
        return []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sample.write(folder)
        files = [path for each in sample.files for path in folder.rglob(each) if path.is_file()]
        largest = max(files, key=lambda path: (path.stat().st_size, path.name))
        largest.write_bytes(bytes(1000))
        words = [word.replace("FOLDER", str(folder)) for word in sample.command]
        done = semsplat_of(tree, *words)
        names = [largest.name, largest.parent.name, folder.name]
        lines = (done.stdout + done.stderr).strip().splitlines() or [""]
        # Jobs that list faults end with their number.
        lines += [line for line in lines if largest.name in line]
        fault = "" if done.returncode in (0, 1, 2) else f"exit status {done.returncode}"
        if not fault and "Traceback" in done.stderr:
            fault = "a traceback"
        message = lines[-1].replace(temporary, "")
        fault = fault or message_fault(message, names)
        attempt = f"semsplat {words[0]}: {largest.name} of zeros"
        return [
            {"sample": name, "attempt": attempt, "fault": fault, "message": message}
            | {"seconds": 0.0, "memory_mb": 0}
        ]


def counted(rows: dict[str, Metrics]) -> Table:
    """Attempts, passed and failed of each area and of all."""
    names = list(next(iter(rows.values()))) if rows else [_NOW]
    columns = ["area", "attempts"]
    for name in reversed(names):
        columns += [f"passed {name}", f"failed {name}"]
    columns += ["longest now, s", "most memory now, MB"]
    cells, sums = [], Counter[str]()
    for area, metrics in rows.items():
        counts = {f"failed {name}": len(metrics[name]["failures"]) for name in names}
        counts |= {f"passed {n}": metrics[n]["attempts"] - counts[f"failed {n}"] for n in names}
        counts["attempts"] = metrics[_NOW]["attempts"]
        sums.update(counts)
        now = metrics[_NOW]
        ends = (f"{now['longest_s']:.1f}", f"{max(0, now['largest_mb']):.0f}")
        cells.append((area, *(str(counts[c]) for c in columns[1:-2]), *ends))
    cells.append(("all", *(str(sums[c]) for c in columns[1:-2]), "", ""))
    return Table(tuple(columns), tuple(cells))


def by_cause(rows: dict[str, Metrics], name: str) -> Table:
    """The failures of a commit by cause, with an example of each."""
    found: dict[tuple[str, str], list[Metrics]] = {}
    for area, metrics in rows.items():
        for failure in metrics[name]["failures"]:
            found.setdefault((failure["fault"], area), []).append(failure)
    ordered = sorted(found.items(), key=lambda each: (-len(each[1]), each[0]))
    cells = [
        (cause, area, str(len(some)), _cell(f"{some[0]['sample']}, {some[0]['attempt']}"))
        for (cause, area), some in ordered
    ]
    columns = ("cause", "area", "failures", "for instance")
    return Table(columns, tuple(cells), f"Failures {name}", "" if cells else "None.")


def _cell(text: str) -> str:
    return text.replace("|", "/").replace("\n", " ")[:100]


if __name__ == "__main__":
    main()
