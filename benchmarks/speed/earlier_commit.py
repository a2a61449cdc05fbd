"""Time per frame beside an earlier commit, which another machine's table cannot hide.

    SEMSPLAT_DATA=DATA python -m benchmarks.speed.earlier_commit [--commit dbd490e] [--rounds 3]

The earlier commit is checked out and compiled in a temporary folder. Both versions process the
same sequence in turn, frame by frame, so that changes of the machine's speed affect both alike.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.shared.programs import LineWorker, earlier_tree, line_worker
from benchmarks.shared.recordings import source_of
from benchmarks.shared.repository import ROOT
from benchmarks.shared.runner import Report, ReportOptions
from benchmarks.shared.tables import Metrics, Target, median_of, table_of, target_table

COLUMNS = (
    *("online_ms_before", "online_ms", "online_ratio", "finish_ms_before", "finish_ms"),
    *("finish_ratio", "total_ratio"),
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


def compare(earlier: Path, job: Mapping[str, Any], number: int) -> Metrics:
    """Times of an earlier tree and of this one over a sequence.

    Args:
        earlier: the other tree.
        job: the sequence, and environment variables in capitals.
        number: of the round; the version that begins a frame alternates.
    """
    variables = {name: value for name, value in job.items() if name.isupper()}
    kind, path, image_size = source_of(job["sequence"])
    program = [str(_WORKER), json.dumps((kind, str(path), image_size))]
    with (
        line_worker(earlier, program, variables) as before,
        line_worker(ROOT, program, variables) as now,
    ):
        frames, _ = (int(worker.answer()) for worker in (before, now))
        times: Mapping[LineWorker, list[float]] = {before: [], now: []}
        for index in range(frames + 1):
            turn = (before, now) if (index + number) % 2 == 0 else (now, before)
            for worker in turn:
                request = "frame" if index < frames else "finish"
                times[worker].append(_answer_ms(worker, request))
    metrics: Metrics = {}
    for worker, suffix in ((before, "_before"), (now, "")):
        metrics[f"online_ms{suffix}"] = sum(times[worker][:frames]) / frames
        metrics[f"finish_ms{suffix}"] = times[worker][frames] / frames
    for stage in ("online", "finish"):
        metrics[f"{stage}_ratio"] = metrics[f"{stage}_ms"] / metrics[f"{stage}_ms_before"]
    return metrics | {"total_ratio": sum(times[now]) / sum(times[before])}


def _answer_ms(worker: LineWorker, request: str) -> float:
    worker.ask(request)
    time_ms = float(worker.answer())
    time.sleep(_PAUSE_S)
    return time_ms


if __name__ == "__main__":
    main()
