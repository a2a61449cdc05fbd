"""A long walk through a ring of rooms, with and without what takes its drift out.

    python benchmarks/ring.py RING [--image-size 160 120] [--drift 0.08] [--seeds N]

RING is made by `semsplat make-room --out RING --layout ring --frames 900 --sensor-noise`. Each row
adds one thing: loops between submaps, loops inside them, refinement at the end. `--drift` moves
each new submap by so many metres, and turns it by a quarter of a radian a metre, in a direction of
its own: that is where odometry can go wrong without a word, since within a submap the map itself
holds the camera. Submaps and links between them are off alike, and only loops can tell.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from machine import describe_machine  # type: ignore[import-not-found]
from numpy.typing import NDArray
from tqdm import tqdm

from toolkit.cli.run import build_slam
from toolkit.cli.run_results import write_results
from toolkit.datasets.registry import open_dataset
from toolkit.evaluation.timing import StageRecorder
from toolkit.frame import Frame
from toolkit.geometry import se3
from toolkit.loops.log import read_loop_log
from toolkit.run_folder import RunFolder
from toolkit.settings.files import dump
from toolkit.settings.run import RunSettings
from toolkit.submaps.atlas import Atlas

COLUMNS = (
    "ate_rmse_cm",
    "psnr_db",
    "miou_percent",
    "wall_thickness_cm",
    "wall_thickness_p95_cm",
    "loop_precision_percent",
    "loop_recall_percent",
    "frames_lost",
    "gaussians",
    "tracking_ms_per_frame",
    "mapping_ms_per_frame",
    "refinement_ms_per_frame",
    "peak_memory_mb",
)
RADIANS_A_METRE = 0.25
ROWS: dict[str, dict[str, Any]] = {
    "one map, no loops": {"submaps": {"use": False}, "loops": {"use": False}, "refine": False},
    "submaps, no loops": {"loops": {"use": False}, "refine": False},
    "loops between submaps": {"loops": {"closing": {"within": False}}, "refine": False},
    "and inside them": {"refine": False},
    "and refinement": {"refine": True},
}


@dataclass(frozen=True)
class Options:
    """Walk through a ring of rooms."""

    room: tyro.conf.Positional[Path]
    """The rooms."""
    image_size: tuple[int, int] | None = None
    """Width and height; native if unset."""
    drift: float = 0.0
    """Error of each new submap's place, in metres."""
    seeds: int = 1
    """Seeds 0, 1, ...; a row is their median."""
    only: tuple[str, ...] = ()
    """Names of rows; all without it."""
    frames: int | None = None
    """Only so many."""


def let_drift(atlas: Atlas, metres: float, seed: int) -> None:
    """Put each new submap somewhat elsewhere than the camera is."""
    begin_next, generator = atlas.begin_next, np.random.default_rng(seed)

    def begin_elsewhere(frame: Frame) -> NDArray[np.float64]:
        T_new_old = begin_next(frame)
        directions = generator.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        error = se3.exp(metres * np.concatenate([directions[0], RADIANS_A_METRE * directions[1]]))
        atlas.move(atlas.active, atlas.T_world_submap(atlas.active) @ error)
        return T_new_old

    atlas.begin_next = begin_elsewhere  # type: ignore[method-assign]


def main() -> None:
    """Print one row a variant."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    print(f"\n{options.room.name}, drift {options.drift}, {options.seeds} seeds\n")
    print("| | " + " | ".join(COLUMNS) + " | submaps | loops | keyframes moved |")
    print("|---" * (len(COLUMNS) + 4) + "|", flush=True)
    for name, values in ROWS.items():
        if options.only and name not in options.only:
            continue
        runs = [walked(options, dict(values), seed) for seed in range(options.seeds)]
        names = (*COLUMNS, "submaps", "loops", "corrections")
        cells = [_median([run.get(column) for run in runs]) for column in names]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def walked(options: Options, values: dict[str, Any], seed: int) -> dict[str, Any]:
    """metrics.json of one walk, and what its loops did."""
    refine = values.pop("refine")
    values |= {
        "dataset": {"kind": "synthetic", "path": str(options.room)},
        "image_size": options.image_size,
        "max_frames": options.frames,
        "seed": seed,
        "mapping": {} if refine else {"final_iterations": 0},
    }
    settings = RunSettings.model_validate(values)
    dataset = open_dataset("synthetic", options.room, settings.image_size, settings.max_frames)
    watch = StageRecorder()
    with tempfile.TemporaryDirectory() as place:
        folder = RunFolder.create(Path(place) / "run", dump(settings))
        slam = build_slam(settings, dataset, watch, folder)
        if options.drift:
            let_drift(slam.atlas, options.drift, seed)
        for index in tqdm(range(len(dataset)), disable=not os.isatty(2), file=sys.stderr):
            slam.process_frame(dataset[index])
        slam.finish()
        folder.check_taxonomy(slam.taxonomy)
        write_results(slam, dataset, folder, settings, watch)
        records = read_loop_log(folder.loops)
        metrics: dict[str, Any] = json.loads(folder.metrics.read_text())
    closed = [r for r in records if r["kind"] == "correction between"]
    moved = [r for r in records if r["kind"] == "correction within" and r["applied"]]
    loops = closed[-1]["loops"] if closed else 0
    return metrics | {"submaps": len(slam.atlas), "loops": loops, "corrections": len(moved)}


def _median(values: list[Any]) -> str:
    if any(value is None for value in values):
        return "n/a"
    middle = statistics.median(values)
    return str(middle) if isinstance(middle, int) else f"{middle:.4g}"


if __name__ == "__main__":
    main()
