"""Time per frame beside an earlier commit, which another machine's table cannot hide.

    SEMSPLAT_DATA=DATA python -m benchmarks.earlier_commit [--commit dbd490e] [--rounds 3]

The earlier commit is checked out and compiled in a temporary folder. Both versions process the
same sequence in turn, frame by frame, so that changes of the machine's speed affect both alike.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.recordings import RECORDINGS, room
from benchmarks.report import Report, ReportOptions
from benchmarks.repository import ROOT
from benchmarks.tables import Metrics, Target, median_of, table_of, target_table

COLUMNS = (
    "online_ms_before",
    "online_ms",
    "online_ratio",
    "finish_ms_before",
    "finish_ms",
    "finish_ratio",
    "total_ratio",
)
DESCRIPTION = """\
Milliseconds per frame of the commit {commit} and of this one: `process_frame` (online), and the
refinement and fusion at the end spread over the frames (finish). Both versions process the same
frames in turn, in processes of their own, with default settings; images are loaded outside the
measured time. Rows of AVX2 use that instruction set (SEMSPLAT_ISA), the others the machine's best.
Medians over {rounds} rounds; of ratios, too."""
SEQUENCES = ("redkitchen", "fr1_rpy", "room")
# Largest ratio of the total time that the detection of wrong poses was allowed to cost.
_MAX_RATIO = 1.05
# After a turn: threads of the process, such as those of OpenBLAS, may still be busy.
_PAUSE_S = 0.04
_WORKER = Path(__file__).with_name("frame_worker.py")


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Compare the time per frame with that of an earlier commit."""

    commit: str = "dbd490e"
    """The earlier commit; by default, the one before frames could be doubtful."""
    rounds: int = 3
    """Number of comparisons of each row."""


def main() -> None:
    """Compare both versions on each sequence, with both instruction sets."""
    options = tyro.cli(Options)
    description = DESCRIPTION.format(commit=options.commit, rounds=options.rounds)
    title = f"Time per frame beside {options.commit}"
    report = Report("earlier-commit", title, description, options, range(options.rounds))
    jobs = {
        f"{sequence}{suffix}": {"commit": options.commit, "sequence": sequence, **variables}
        for suffix, variables in (("", {}), (", AVX2", {"SEMSPLAT_ISA": "avx2"}))
        for sequence in SEQUENCES
    }
    with earlier_tree(options.commit) as tree:
        rows = report.measured(jobs, lambda job, number: compare(tree, job, number))
    ratios = median_of(rows)
    targets = [
        Target(f"{name}, ratio of total time", ratios(name, "total_ratio"), at_most=_MAX_RATIO)
        for name in jobs
    ]
    report.write(table_of(COLUMNS, rows, "sequence"), target_table(targets))


@contextmanager
def earlier_tree(commit: str) -> Iterator[Path]:
    """A compiled checkout of a commit, which exists within this context."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), commit], check=True)
        try:
            build = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
            subprocess.run(build, cwd=tree, check=True)
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def compare(earlier: Path, job: Mapping[str, Any], number: int) -> Metrics:
    """Times of an earlier tree and of this one over a sequence.

    Args:
        earlier: the other tree.
        job: the sequence, and environment variables in capitals.
        number: of the round; the version that begins a frame alternates.
    """
    sequence = job["sequence"]
    variables = {name: value for name, value in job.items() if name.isupper()}
    with (
        _worker(earlier, sequence, variables) as before,
        _worker(ROOT, sequence, variables) as now,
    ):
        frames, _ = (int(worker.answer()) for worker in (before, now))
        times: Mapping[_Worker, list[float]] = {before: [], now: []}
        for index in range(frames + 1):
            turn = (before, now) if (index + number) % 2 == 0 else (now, before)
            for worker in turn:
                times[worker].append(worker.ask("frame" if index < frames else "finish"))
    metrics: Metrics = {}
    for worker, suffix in ((before, "_before"), (now, "")):
        metrics[f"online_ms{suffix}"] = sum(times[worker][:frames]) / frames
        metrics[f"finish_ms{suffix}"] = times[worker][frames] / frames
    for stage in ("online", "finish"):
        metrics[f"{stage}_ratio"] = metrics[f"{stage}_ms"] / metrics[f"{stage}_ms_before"]
    return metrics | {"total_ratio": sum(times[now]) / sum(times[before])}


class _Worker:
    """A process that handles a sequence frame by frame."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, request: str) -> float:
        """Time in milliseconds of a request."""
        assert self._process.stdin is not None
        self._process.stdin.write(request + "\n")
        self._process.stdin.flush()
        time_ms = self.answer()
        time.sleep(_PAUSE_S)
        return time_ms

    def answer(self) -> float:
        """The next number that the process prints.

        Raises:
            SystemExit: it ended without one.
        """
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("answer "):
                return float(line.split()[1])
        raise SystemExit(f"{_WORKER.name} ended with status {self._process.wait()}")


@contextmanager
def _worker(tree: Path, sequence: str, variables: Mapping[str, str]) -> Iterator[_Worker]:
    if sequence in RECORDINGS:
        recording = RECORDINGS[sequence]
        data: tuple[object, ...] = (recording.kind, str(recording.path), recording.image_size)
    else:
        data = ("synthetic", str(room(sequence)), None)
    # -P: the folder of the worker would be searched first for modules.
    command = [sys.executable, "-P", str(_WORKER), json.dumps(data)]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **variables, "PYTHONPATH": str(tree)},
        cwd=tree,
    )
    try:
        yield _Worker(process)
    finally:
        process.kill()
        process.wait()


if __name__ == "__main__":
    main()
