"""Hashes of the results of short runs, to show that a change leaves them as they were.

    SEMSPLAT_DATA=DATA python -m benchmarks.code.result_hashes --write before.json
    SEMSPLAT_DATA=DATA python -m benchmarks.code.result_hashes --compare before.json

Each of the sequences (RedKitchen, fr1_rpy, office0 with and without its depth, and a ring of
rooms) runs in a process of its own with two threads, or with OMP_NUM_THREADS. Rounding differs
between processors and instruction sets, so hashes are compared on one machine only.

Hashed are `trajectory.txt`, `map.ply`, `loops.jsonl` and the values of `metrics.json` other than
times and memory, by dotted key. Metrics that only one side has are listed but do not count. The
exit status is 1 where anything differs.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.shared.machine import describe_machine
from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.runs import finished_run

FILES = ("trajectory.txt", "map.ply", "loops.jsonl")
# Metrics that no two runs share.
UNSTABLE = ("_ms", "_ms_per_frame", "_s", "peak_mb")
# Sequence and further options.
ROWS = {
    "redkitchen": ["redkitchen", "--max-frames", "50"],
    "fr1_rpy": ["fr1_rpy", "--max-frames", "30"],
    "office0": ["office0", "--max-frames", "8"],
    "office0-colour": [
        *("office0", "--image-size", "300", "170", "--depth", "none", "--max-frames", "30")
    ],
    "ring": ["ring-small"],
}


@dataclass(frozen=True)
class Options:
    """Run the short sequences and hash what they leave."""

    write: Path | None = None
    """JSON file to write."""
    compare: Path | None = None
    """JSON file of an earlier run on this machine to compare with."""
    only: tuple[str, ...] = tuple(ROWS)
    """Names of sequences to run."""


def main() -> int:
    """Print one line for each sequence and file."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    os.environ.setdefault("OMP_NUM_THREADS", "2")
    before = json.loads(options.compare.read_text()) if options.compare else {}
    rows, differences = {}, 0
    for name in options.only:
        rows[name] = row = _results(*ROWS[name])
        old = before.get(name, {})
        for file in FILES:
            differences += _report(name, file, row[file], old.get(file))
        differences += _report_metrics(name, row["metrics"], old.get("metrics"))
    if options.write is not None:
        options.write.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 1 if differences else 0


def _results(sequence: str, *options: str) -> dict[str, Any]:
    """Hashes of files, and the values of the stable metrics."""
    with finished_run([*sequence_arguments(sequence), *options], 0) as (metrics, folder):
        results: dict[str, Any] = {file: _hash(folder.path / file) for file in FILES}
        results["metrics"] = {k: v for k, v in metrics.items() if not k.endswith(UNSTABLE)}
        return results


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.exists() else "absent"


def _report(name: str, file: str, now: str, before: str | None) -> bool:
    verdict = "" if before is None else "  same" if now == before else f"  DIFFERS from {before}"
    print(f"{name:12} {file:16} {now}{verdict}", flush=True)
    return before is not None and now != before


def _report_metrics(name: str, now: dict[str, Any], before: dict[str, Any] | None) -> bool:
    digest = hashlib.sha256(json.dumps(now, sort_keys=True).encode()).hexdigest()[:16]
    old = now if before is None else before
    changed = [k for k in now if k in old and now[k] != old[k]]
    verdict = "" if before is None else "  DIFFERS" if changed else "  same"
    print(f"{name:12} {'metrics.json':16} {digest}{verdict}", flush=True)
    for key in changed:
        print(f"{'':12}   {key}: {old[key]} -> {now[key]}")
    if set(now) != set(old):
        print(f"{'':12}   only on one side: {', '.join(sorted(set(now) ^ set(old)))}")
    return bool(changed)


if __name__ == "__main__":
    sys.exit(main())
