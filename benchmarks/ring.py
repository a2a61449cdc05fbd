"""A long sequence through a ring of rooms, with and without what corrects its drift.

    python -m benchmarks.ring --table summary
    python -m benchmarks.ring --table ablation --seeds 5 --image-size 160 120

Tables:

summary       odometry alone, everything, and everything with added drift
loops         each row adds one thing: loops between submaps, loops inside them, refinement
ablation      each row leaves one thing out, or does it otherwise
allocation    when the next submap starts
registration  how submaps are registered

Added drift moves each new submap by 0.13 m in a random direction and turns it by a quarter of a
radian per metre. Only loops can correct it, since submaps and the odometry edges between them are
displaced alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.recordings import room
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import FinishedSlam, finished_slam
from benchmarks.tables import (
    Metrics,
    Rows,
    Table,
    Target,
    median_cell,
    median_of,
    table_of,
    target_table,
)
from toolkit.base.geometry import se3
from toolkit.base.options import validated
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.run_metrics import measure_run
from toolkit.runs.outcome import tracked_frames
from toolkit.runs.settings import RunSettings
from toolkit.slam.result import SlamResult
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.system import Slam

TableName = Literal["summary", "loops", "ablation", "allocation", "registration"]

DRIFT_M = 0.13
RADIANS_PER_METRE = 0.25
# Frames on either side of a boundary whose renders are evaluated separately.
AROUND = 5
# Share of the image that a component of a class must cover to count as an object in view.
MIN_OBJECT = 0.01
SHELL = ("wall", "floor", "ceiling", "window", "door")

QUALITY = (
    "trajectory.ate_rmse_cm",
    "images.mapped.psnr_db",
    "images.mapped.ssim",
    "semantics.mapped.miou_percent",
)
WALLS = ("map.walls.thickness_cm", "map.walls.thickness_p95_cm")
TIMES = ("time.tracking_ms_per_frame", "time.mapping_ms_per_frame", "time.refinement_ms_per_frame")
RECALL = ("loops.verified.overlap.precision_percent", "loops.verified.overlap.recall_percent")
LOOPS = (*RECALL, "loops", "keyframes moved")
SIZE = ("submaps", "map.gaussians", "frames.lost", "memory.peak_mb")
BOUNDARIES = ("submaps", "objects cut", "psnr at boundaries", *QUALITY)
EVERYTHING = "loops and refinement"
ODOMETRY = "no loops, no refinement"
DRIFTED = f"{EVERYTHING}, {DRIFT_M} m of drift per submap"

DESCRIPTION = """\
The synthetic ring (`semsplat make-room --layout ring --frames 900 --sensor-noise --seed SEED`):
four rooms, 26 m of path, the last quarter revisits the first room. With several seeds, each has a
ring of its own, and a row is the median over them."""


@dataclass(frozen=True)
class Row:
    """One variant.

    Attributes:
        settings: those that differ from the defaults.
        room: a key of ROOMS.
        drift_m: displacement of each new submap.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    room: str = "ring"
    drift_m: float = 0.0


NO_REFINEMENT = {"mapping": {"final_iterations": 0}}
NO_LOOPS = {"loops": {"use": False}}
PLACES_ONLY = {"submaps": {"allocation": {"min_divergence": 0.0}}}
MOTION = {"submaps": {"allocation": {"rule": "motion"}}}


def _registered_by(kind: str) -> Row:
    return Row({"registration": {"kind": kind}})


TABLES: dict[TableName, tuple[tuple[str, ...], dict[str, Row]]] = {
    "summary": (
        (*QUALITY, *WALLS, *LOOPS, *SIZE, *TIMES),
        {
            ODOMETRY: Row({**NO_LOOPS, **NO_REFINEMENT}),
            EVERYTHING: Row(),
            DRIFTED: Row(drift_m=DRIFT_M),
        },
    ),
    "loops": (
        (*QUALITY, *WALLS, *LOOPS, *SIZE, *TIMES),
        {
            "one map, no loops": Row({"submaps": {"use": False}, **NO_LOOPS, **NO_REFINEMENT}),
            "submaps, no loops": Row({**NO_LOOPS, **NO_REFINEMENT}),
            "loops between submaps": Row(
                {"loops": {"closing": {"within": False}}, **NO_REFINEMENT}
            ),
            "and inside them": Row(NO_REFINEMENT),
            "and refinement": Row(),
            "and refinement, ring without noise": Row(room="ring-ideal"),
        },
    ),
    "ablation": (
        (*QUALITY, *WALLS, *RECALL, "submaps", "loops"),
        {
            EVERYTHING: Row(),
            "allocation by overlap alone": Row(PLACES_ONLY),
            "seeds by class (G)": Row({"mapping": {"seeding": {"choice": "semantic"}}}),
            "as many seeds, uniform": Row({"mapping": {"seeding": {"choice": "uniform"}}}),
            "no loops": Row(NO_LOOPS),
            "no refinement": Row(NO_REFINEMENT),
        },
    ),
    "allocation": (
        BOUNDARIES,
        {
            "overlap and classes": Row(),
            "overlap alone": Row(PLACES_ONLY),
            "motion (0.5 m or 50 degrees)": Row(MOTION),
        },
    ),
    "registration": (
        (*QUALITY, *LOOPS),
        {
            "SGR (default)": Row(),
            "coarse alone": _registered_by("coarse"),
            "fine alone": _registered_by("fine"),
        },
    ),
}


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Run the ring of rooms."""

    table: TableName = "summary"
    """Which rows."""
    image_size: tuple[int, int] | None = None
    """Width and height in pixels; native (320x240) if unset."""
    seeds: int = 1
    """Seeds 0, 1, ... of rings and runs; a row is their median."""
    frames: int | None = None
    """Number of frames from the start; all if unset. Give --out with it."""


def main() -> None:
    """Measure one table."""
    options = tyro.cli(Options)
    columns, rows = TABLES[options.table]
    size = "" if options.image_size is None else "-{}x{}".format(*options.image_size)
    report = Report(
        f"ring-{options.table}{size}",
        f"Ring of rooms: {options.table}{size.replace('-', ', ')}",
        DESCRIPTION,
        options,
        range(options.seeds),
    )
    jobs = {
        name: {**vars(row), "image_size": options.image_size, "max_frames": options.frames}
        for name, row in rows.items()
    }
    found = report.measured(jobs, lambda job, seed: measure(job, seed, options.table))
    tables = [table_of(columns, found)]
    if options.seeds > 1:
        tables.append(each_ring(found, options.seeds))
    targets = summary_targets(found) if options.table == "summary" else []
    report.write(*tables, *([target_table(targets)] if targets else []))


def each_ring(rows: Rows, seeds: int) -> Table:
    """ATE and loops of each ring by itself."""
    cells = []
    for name, runs in rows.items():
        for column in ("trajectory.ate_rmse_cm", *RECALL):
            cells.append((f"{name}: {column}", *(median_cell([r.get(column)]) for r in runs)))
    columns = ("", *(f"ring {seed}" for seed in range(seeds)))
    return Table(columns, tuple(cells), "Each ring")


def summary_targets(rows: Rows) -> list[Target]:
    """What loops and refinement should reach."""
    median = median_of(rows)
    return [
        Target("ATE in cm", median(EVERYTHING, "trajectory.ate_rmse_cm"), at_most=0.5),
        Target(
            "precision of loops in %",
            median(EVERYTHING, "loops.verified.overlap.precision_percent"),
            at_least=100,
        ),
        Target(
            "recall of loops in %",
            median(EVERYTHING, "loops.verified.overlap.recall_percent"),
            at_least=85,
        ),
        Target(
            "ATE with added drift in cm", median(DRIFTED, "trajectory.ate_rmse_cm"), at_most=1.5
        ),
    ]


def measure(job: dict[str, Any], seed: int, table: TableName) -> Metrics:
    """Run one variant; metrics.json and what its loops did."""
    place = room(job["room"], seed)
    settings = validated(
        RunSettings,
        job["settings"]
        | {
            "dataset": {"kind": "synthetic", "path": str(place)},
            "image_size": job["image_size"],
            "max_frames": job["max_frames"],
            "seed": seed,
        },
    )
    dataset = open_dataset("synthetic", place, settings.image_size, settings.max_frames)

    def prepare(slam: Slam) -> None:
        if job["drift_m"]:
            add_drift(slam.atlas, job["drift_m"], seed)

    with finished_slam(settings, dataset, prepare) as run:
        metrics = run.metrics | loop_counts(run)
        if table == "allocation":
            metrics |= at_boundaries(run.result, dataset, settings)
        return metrics


def loop_counts(run: FinishedSlam) -> Metrics:
    """Submaps, loops between them, and corrections inside them."""
    between = [r for r in run.records if r["kind"] == "correction between"]
    within = [r for r in run.records if r["kind"] == "correction within" and r["applied"]]
    return {
        "submaps": len(run.result.submaps),
        "loops": between[-1]["loops"] if between else 0,
        "keyframes moved": len(within),
    }


def add_drift(atlas: Atlas, metres: float, seed: int) -> None:
    """Displace each new submap from where the camera is."""
    start, generator = atlas.start, np.random.default_rng(seed)

    def start_displaced(submap: Submap) -> None:
        directions = generator.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        error = se3.exp(metres * np.concatenate([directions[0], RADIANS_PER_METRE * directions[1]]))
        submap.T_world_submap = submap.T_world_submap @ error
        start(submap)

    atlas.start = start_displaced  # type: ignore[method-assign]


def at_boundaries(result: SlamResult, dataset: Dataset, settings: RunSettings) -> Metrics:
    """Number of objects in view where submaps meet, and image quality of the map there."""
    boundaries = [submap.keyframe_indices[0] for submap in result.submaps[1:]]
    near = [
        frame
        for frame in tracked_frames(result, settings)
        if any(abs(frame.index - boundary) <= AROUND for boundary in boundaries)
    ]
    names = dataset.label_names or {}
    shell = [number for number, name in names.items() if name in SHELL]
    psnr = None
    if near:
        psnr = measure_run(result.map, near, dataset)["images"]["mapped"]["psnr_db"]
    cut = sum(_objects(dataset[boundary].labels, shell) for boundary in boundaries)
    return {"objects cut": cut, "psnr at boundaries": psnr}


def _objects(labels: NDArray[np.int32] | None, shell: list[int]) -> int:
    """Number of connected components of one class, walls, floor and the like excluded."""
    if labels is None:
        return 0
    count = 0
    for number in np.setdiff1d(np.unique(labels), [0, *shell]):
        mask = (labels == number).astype(np.uint8)
        _, _, statistics, _ = cv2.connectedComponentsWithStats(mask)
        count += int((statistics[1:, cv2.CC_STAT_AREA] >= MIN_OBJECT * labels.size).sum())
    return count


if __name__ == "__main__":
    main()
