"""Hashes of the results of short runs, to show that a change leaves them as they were.

    SEMSPLAT_DATA=DATA python -m benchmarks.result_hashes --ring RING --write before.json
    SEMSPLAT_DATA=DATA python -m benchmarks.result_hashes --ring RING --compare before.json

RING is made by `semsplat make-room --out RING --layout ring --frames 450 --sensor-noise
--image-size 160 120`. Each of the sequences (RedKitchen, fr1_rpy, office0 with and without its
depth, and the ring) runs in a process of its own with two threads, or with OMP_NUM_THREADS.
Rounding differs between processors and instruction sets, so hashes are compared on one machine
only.

Hashed are `trajectory.txt`, `map.ply`, `loops.jsonl` and the values of `metrics.json` other than
times and memory, by dotted key. With `--compare`, metrics that only one side has are listed but do
not count: those are all of them in a file that was written while `metrics.json` was flat.
The exit status is 1 where anything differs.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.machine import describe_machine
from benchmarks.programs import semsplat_command
from toolkit.runs.evaluation.metrics import flattened, read_metrics

FILES = ("trajectory.txt", "map.ply", "loops.jsonl")
# Metrics that no two runs share.
UNSTABLE = ("_ms", "_ms_per_frame", "_s", "peak_mb")


@dataclass(frozen=True)
class Options:
    """Run the short sequences and hash what they leave."""

    ring: Path | None = None
    """The ring of rooms; left out without it."""
    write: Path | None = None
    """JSON file to write."""
    compare: Path | None = None
    """JSON file of an earlier run on this machine to compare with."""
    only: tuple[str, ...] = ()
    """Names of sequences to run; all by default."""


def main() -> int:
    """Print one line for each sequence and file."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    rows = {
        name: _results(arguments)
        for name, arguments in _sequences(options.ring).items()
        if not options.only or name in options.only
    }
    if not rows:
        raise SystemExit("no sequence to run: set SEMSPLAT_DATA, or name a ring with --ring")
    if options.write is not None:
        options.write.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    before = json.loads(options.compare.read_text()) if options.compare else {}
    differences = 0
    for name, row in rows.items():
        for file in FILES:
            differences += _report(name, file, row[file], before.get(name, {}).get(file))
        differences += _report_metrics(name, row["metrics"], before.get(name, {}).get("metrics"))
    return 1 if differences else 0


def _sequences(ring: Path | None) -> dict[str, list[str]]:
    rows: dict[str, list[str]] = {}
    small = ["--image-size", "320", "240"]
    if "SEMSPLAT_DATA" in os.environ:
        data = Path(os.environ["SEMSPLAT_DATA"])
        kitchen, rpy = str(data / "7scenes_redkitchen"), str(data / "tum_fr1_rpy")
        office = str(data / "replica_office0")
        rows["redkitchen"] = [*_dataset("seven-scenes", kitchen), *small, "--max-frames", "50"]
        rows["fr1_rpy"] = [*_dataset("tum", rpy), *small, "--max-frames", "30"]
        rows["office0"] = [*_dataset("replica", office), "--max-frames", "8"]
        colour = ["--image-size", "300", "170", "--depth", "none", "--max-frames", "30"]
        rows["office0-colour"] = [*_dataset("replica", office), *colour]
    if ring is not None:
        rows["ring"] = _dataset("synthetic", str(ring))
    return rows


def _dataset(kind: str, path: str) -> list[str]:
    return ["--dataset.kind", kind, "--dataset.path", path]


def _results(arguments: list[str]) -> dict[str, Any]:
    """Hashes of files, and the values of the stable metrics."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = semsplat_command("run", "--out", str(out), *arguments)
        environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "2")}
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL, env=environment)
        results: dict[str, Any] = {file: _hash(out / file) for file in FILES}
        metrics = flattened(read_metrics(out / "metrics.json"))
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
    changed = [k for k in now if before is not None and k in before and now[k] != before[k]]
    verdict = "" if before is None else "  DIFFERS" if changed else "  same"
    print(f"{name:12} {'metrics.json':16} {digest}{verdict}", flush=True)
    for key in changed:
        print(f"{'':12}   {key}: {before[key] if before else None} -> {now[key]}")
    if before is not None and set(now) != set(before):
        print(f"{'':12}   only on one side: {', '.join(sorted(set(now) ^ set(before)))}")
    return bool(changed)


if __name__ == "__main__":
    sys.exit(main())
