"""Runs `semsplat run` with its default settings on every sequence and prints a table.

    SEMSPLAT_DATA=DATA python -m benchmarks.sequences --room DIR --noisy-room DIR

Rooms are made by `semsplat make-room --out DIR [--sensor-noise]`. Each run is a process of
its own. A row is the median over the seeds, for times too.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.machine import describe_machine

COLUMNS = (
    "ate_rmse_cm",
    "rpe_rotation_deg",
    "frames_lost",
    "psnr_db",
    "psnr_unseen_db",
    "psnr_unseen_refined_db",
    "ssim",
    "depth_l1_cm",
    "gaussians",
    "tracking_ms_per_frame",
    "labelling_ms_per_frame",
    "mapping_ms_per_frame",
    "refinement_ms_per_frame",
    "peak_memory_mb",
)


@dataclass(frozen=True)
class Options:
    """Run every sequence."""

    room: Path | None = None
    """A noise-free synthetic room."""
    noisy_room: Path | None = None
    """A synthetic room with sensor noise."""
    seeds: int = 3
    """Seeds 0, 1, ... of each sequence."""
    only: tuple[str, ...] = ()
    """Names of rows to run; all without it."""
    extra: str = ""
    """Further options of every run, in one string."""


def main() -> None:
    """Print one row a sequence."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    print("\n| sequence | " + " | ".join(COLUMNS) + " |")
    print("|---" * (len(COLUMNS) + 1) + "|", flush=True)
    for name, arguments in _sequences(options).items():
        if options.only and name not in options.only:
            continue
        runs = [_run([*arguments, *options.extra.split()], seed) for seed in range(options.seeds)]
        cells = [_median([run.get(column) for run in runs]) for column in COLUMNS]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def _sequences(options: Options) -> dict[str, list[str]]:
    rows: dict[str, list[str]] = {}
    if "SEMSPLAT_DATA" in os.environ:
        data = Path(os.environ["SEMSPLAT_DATA"])
        small = ["--image-size", "320", "240"]
        kitchen, office = str(data / "7scenes_redkitchen"), str(data / "replica_office0")
        rows["7scenes_redkitchen"] = [*_dataset("seven-scenes", kitchen), *small]
        rows["tum_fr1_rpy"] = [*_dataset("tum", str(data / "tum_fr1_rpy")), *small]
        rows["replica_office0"] = _dataset("replica", office)
        given = ["--poses", "given", "--hold-out", "5"]
        rows["replica_office0, poses given"] = [*_dataset("replica", office), *given]
    if options.room:
        rows["room"] = _dataset("synthetic", str(options.room))
    if options.noisy_room:
        rows["room, sensor noise"] = _dataset("synthetic", str(options.noisy_room))
    return rows


def _dataset(kind: str, path: str) -> list[str]:
    return ["--dataset.kind", kind, "--dataset.path", path]


def _run(arguments: list[str], seed: int) -> dict[str, float | str | None]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "toolkit.cli.main", "run", "--out", str(out)]
        command += [*arguments, "--seed", str(seed)]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        metrics: dict[str, float | str | None] = json.loads((out / "metrics.json").read_text())
        return metrics


def _median(values: list[float | str | None]) -> str:
    numbers = [float(v) for v in values if v is not None]
    if not numbers:
        return "n/a"
    median = statistics.median(numbers)
    return f"{median:.0f}" if abs(median) >= 100 or median == int(median) else f"{median:.3f}"


if __name__ == "__main__":
    main()
