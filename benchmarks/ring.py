"""A long walk through a ring of rooms, with and without what takes its drift out.

    python -m benchmarks.ring RING [--table loops] [--image-size 160 120] [--drift 0.08]

RING is made by `semsplat make-room --out RING --layout ring --frames 900 --sensor-noise`; with
several seeds, RING-0, RING-1 and so on, made with `--seed N`, where they exist. Tables:

loops         each row adds one thing: loops between submaps, loops inside them, refinement
ablation      each row leaves one thing out, or does it otherwise
allocation    when the next submap begins
registration  how submaps are joined

`--drift` moves each new submap by so many metres, and turns it by a quarter of a radian a metre,
in a direction of its own: that is where odometry can go wrong without a word, since within a
submap the map itself holds the camera. Submaps and links between them are off alike, and only
loops can tell.
"""

from __future__ import annotations

import json
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks import walks
from benchmarks.machine import describe_machine
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.evaluation.run_metrics import measure_run
from toolkit.geometry import se3
from toolkit.options import validated
from toolkit.runs.results import tracked_frames
from toolkit.runs.settings import RunSettings
from toolkit.slam import Slam
from toolkit.submaps.atlas import Atlas

RADIANS_A_METRE = 0.25
# Frames on either side of a boundary whose renders are scored apart.
AROUND = 5
# Of the image, for a piece of a class to be an object in view.
LEAST_OBJECT = 0.01
SHELL = ("wall", "floor", "ceiling", "window", "door")

QUALITY = ("ate_rmse_cm", "psnr_db", "ssim", "miou_percent")
WALLS = ("wall_thickness_cm", "wall_thickness_p95_cm")
TIMES = ("tracking_ms_per_frame", "mapping_ms_per_frame", "refinement_ms_per_frame")
LOOPS = ("loop_precision_percent", "loop_recall_percent", "loops", "keyframes moved")
SIZE = ("submaps", "gaussians", "frames_lost", "peak_memory_mb")
BOUNDARIES = ("submaps", "objects cut", "psnr at boundaries", *QUALITY)

Row = dict[str, Any]
NO_REFINEMENT: Row = {"mapping": {"final_iterations": 0}}
NO_LOOPS: Row = {"loops": {"use": False}}
PLACES_ALONE: Row = {"submaps": {"allocation": {"least_divergence": 0.0}}}
MOTION: Row = {"submaps": {"allocation": {"rule": "motion"}}}


def _registered_by(kind: str) -> Row:
    return {"loops": {"registration": {"kind": kind}}}


TABLES: dict[str, tuple[tuple[str, ...], dict[str, Row]]] = {
    "loops": (
        (*QUALITY, *WALLS, *LOOPS, *SIZE, *TIMES),
        {
            "one map, no loops": {"submaps": {"use": False}, **NO_LOOPS, **NO_REFINEMENT},
            "submaps, no loops": {**NO_LOOPS, **NO_REFINEMENT},
            "loops between submaps": {"loops": {"closing": {"within": False}}, **NO_REFINEMENT},
            "and inside them": NO_REFINEMENT,
            "and refinement": {},
        },
    ),
    "ablation": (
        (*QUALITY, "submaps"),
        {
            "everything": {},
            "allocation by places alone": PLACES_ALONE,
            "seeds by class (G)": {"mapping": {"seeding": {"choice": "semantic"}}},
            "as many seeds, uniform": {"mapping": {"seeding": {"choice": "uniform"}}},
            "no loops": NO_LOOPS,
            "no refinement": NO_REFINEMENT,
        },
    ),
    "allocation": (
        BOUNDARIES,
        {
            "places and classes": {},
            "places alone": PLACES_ALONE,
            "motion (0.5 m or 50 degrees)": MOTION,
        },
    ),
    "registration": (
        (*QUALITY, *LOOPS),
        {
            "SGR (default)": {},
            "coarse alone": _registered_by("coarse"),
            "fine alone": _registered_by("fine"),
            "coarse, then two-way": _registered_by("two-way"),
            "FPFH, RANSAC, ICP": _registered_by("clouds"),
        },
    ),
}


@dataclass(frozen=True)
class Options:
    """Walk through a ring of rooms."""

    room: tyro.conf.Positional[Path]
    """The rooms."""
    table: Literal["loops", "ablation", "allocation", "registration"] = "loops"
    """Which rows."""
    image_size: tuple[int, int] | None = None
    """Width and height; native if unset."""
    drift: float = 0.0
    """Error of each new submap's place, in metres."""
    seeds: int = 1
    """Seeds 0, 1, ...; a row is their median."""
    store: Path | None = None
    """Where figures of finished walks are kept; what is in there is not walked again."""
    only: tuple[str, ...] = ()
    """Names of rows; all without it."""
    frames: int | None = None
    """Only so many."""


def let_drift(atlas: Atlas, metres: float, seed: int) -> None:
    """Put each new submap somewhat elsewhere than the camera is."""
    begin_next, generator = atlas.begin_next, np.random.default_rng(seed)

    def begin_elsewhere() -> NDArray[np.float64]:
        T_new_old = begin_next()
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
    columns, rows = TABLES[options.table]
    chosen = {name: row for name, row in rows.items() if not options.only or name in options.only}
    runs: dict[str, list[Row]] = {name: [] for name in chosen}
    for seed in range(options.seeds):
        for name, values in chosen.items():
            runs[name].append(remembered(options, name, values, seed))
    print("| | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|", flush=True)
    for name, found in runs.items():
        cells = [_median([run.get(column) for run in found]) for column in columns]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def remembered(options: Options, name: str, values: Row, seed: int) -> Row:
    """The figures of a walk, from the store if they are there."""
    key = [options.room.name, options.image_size, options.frames, options.drift, name, seed]
    known = []
    if options.store is not None and options.store.exists():
        known = [json.loads(line) for line in options.store.read_text().splitlines()]
    for entry in known:
        if entry["walk"] == json.loads(json.dumps(key)):
            figures: Row = entry["figures"]
            return figures
    figures = figures_of(options, values, seed)
    if options.store is not None:
        with options.store.open("a") as file:
            file.write(json.dumps({"walk": key, "figures": figures}) + "\n")
    return figures


def figures_of(options: Options, values: Row, seed: int) -> Row:
    """metrics.json of one walk, and what its loops did."""
    own = options.room.with_name(f"{options.room.name}-{seed}")
    place = own if own.is_dir() else options.room
    values = values | {
        "dataset": {"kind": "synthetic", "path": str(place)},
        "image_size": options.image_size,
        "max_frames": options.frames,
        "seed": seed,
    }
    settings = validated(RunSettings, values)
    dataset = open_dataset("synthetic", place, settings.image_size, settings.max_frames)

    def prepare(slam: Slam) -> None:
        if options.drift:
            let_drift(slam.atlas, options.drift, seed)

    with walks.walked(settings, dataset, prepare) as walk:
        closed = [r for r in walk.records if r["kind"] == "correction between"]
        moved = [r for r in walk.records if r["kind"] == "correction within" and r["applied"]]
        found = walk.metrics | {
            "submaps": len(walk.slam.atlas),
            "loops": closed[-1]["loops"] if closed else 0,
            "keyframes moved": len(moved),
        }
        if options.table == "allocation":
            found |= at_boundaries(walk.slam, dataset, settings)
        return found


def at_boundaries(slam: Slam, dataset: Dataset, settings: RunSettings) -> Row:
    """How many objects are in view where submaps meet, and how good the map is there."""
    numbers = range(1, len(slam.atlas))
    boundaries = [next(iter(slam.atlas.keyframe_poses(number))) for number in numbers]
    near = [
        frame
        for frame in tracked_frames(slam, settings)
        if any(abs(frame.index - boundary) <= AROUND for boundary in boundaries)
    ]
    names = dataset.label_names or {}
    shell = [number for number, name in names.items() if name in SHELL]
    psnr = None
    if near:
        assert slam.fused is not None
        psnr = measure_run(slam.fused, near, dataset)["psnr_db"]
    cut = sum(_objects(dataset[boundary].labels, shell) for boundary in boundaries)
    return {"objects cut": cut, "psnr at boundaries": psnr}


def _objects(labels: NDArray[np.int32] | None, shell: list[int]) -> int:
    """Connected pieces of one class that are no part of the room's shell."""
    if labels is None:
        return 0
    count = 0
    for number in np.setdiff1d(np.unique(labels), [0, *shell]):
        mask = (labels == number).astype(np.uint8)
        _, _, figures, _ = cv2.connectedComponentsWithStats(mask)
        count += int((figures[1:, cv2.CC_STAT_AREA] >= LEAST_OBJECT * labels.size).sum())
    return count


def _median(values: list[Any]) -> str:
    if any(value is None for value in values):
        return "n/a"
    middle = statistics.median(values)
    return str(middle) if isinstance(middle, int) else f"{middle:.4g}"


if __name__ == "__main__":
    main()
