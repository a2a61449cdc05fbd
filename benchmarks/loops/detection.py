"""Loop detection: what each test contributes.

    python -m benchmarks.loops.detection ring --image-size 160 120
    python -m benchmarks.loops.detection twins --image-size 160 120 --seeds 5 \\
        --rows "and verification (default)"
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from benchmarks.shared.recordings import source_of
from benchmarks.shared.runner import Report, ReportOptions
from benchmarks.shared.runs import finished_slam
from benchmarks.shared.tables import Metrics, Rows, Table, median_cell, table_of
from toolkit.base.options import validated
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.loops import LoopTruthOptions
from toolkit.runs.settings import RunSettings
from toolkit.slam.result import SlamResult

Values = dict[str, Any]

# Every registration is accepted.
_ACCEPT_ALL: Values = {
    "verify": False,
    "closing": {"min_visible": 0.0},
    "pose_graph": {"confidence": 1.0, "kernel": "none"},
}
# No class is ever seen as often, so that landmarks have no effect.
_NO_LANDMARKS: Values = {"landmarks": {"min_count": 10**9}}
# Candidates below the encoder's distance, ordered by landmarks.
_FIXED: Values = _ACCEPT_ALL | {"candidates": {"threshold": "fixed"}}
_PRINTED: Values = {"landmarks": {"weighting": "paper", "counted": "gaussians"}}
ROWS: dict[str, Values] = {
    "no loops": {"use": False},
    "descriptor alone": _FIXED | _NO_LANDMARKS,
    "and landmarks as printed (G-7)": _FIXED | _PRINTED,
    "and landmarks, linear": _FIXED | {"landmarks": {"weighting": "linear"}},
    "and landmarks, square root": _FIXED,
    "by rank, without verification": _ACCEPT_ALL,
    "and verification (default)": {},
}
COLUMNS = (
    *(f"loops.suspected.overlap.{m}_percent" for m in ("precision", "recall", "f1")),
    *(f"loops.verified.overlap.{m}_percent" for m in ("precision", "recall", "f1")),
    *("trajectory.ate_rmse_cm", "images.mapped.psnr_db", "frames.lost", "edges", "edges_false"),
)
DESCRIPTION = """\
Runs with these settings of loop closure, without the final refinement. Without verification, each
registration that converges enters the graph and stays: no bounds on it, no odometry to contradict
it, no robust kernel. "Suspected" metrics are those of the candidates of the search, the others
those of the loops held at the end. A false edge places an anchor more than half a metre from where
the ground truth has it."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure loop detection."""

    rooms: tyro.conf.Positional[tuple[str, ...]] = ("ring",)
    """Sequences: ring, ring-ideal, twins, redkitchen, fr1_rpy."""
    image_size: tuple[int, int] | None = None
    """Width and height in pixels; native if unset."""
    rows: tuple[str, ...] = tuple(ROWS)
    """Rows of the table; the results have no others."""
    seeds: int = 1
    """Seeds 0, 1, ... of rooms and runs."""


def main() -> None:
    """Measure every sequence."""
    options = tyro.cli(Options)
    size = "" if options.image_size is None else "-{}x{}".format(*options.image_size)
    for name in options.rooms:
        title = f"Loop detection on {name}{size.replace('-', ', ')}"
        seeds = range(options.seeds)
        report = Report(f"loops-{name}{size}", title, DESCRIPTION, options, seeds)
        common = {"sequence": name, "image_size": options.image_size}
        jobs = {row: {"loops": ROWS[row], **common} for row in options.rows}
        found = report.measured(jobs, measure)
        report.write(table_of(COLUMNS, found), *each_seed(found))


def each_seed(rows: Rows) -> list[Table]:
    """Each seed by itself, if there are several: a room is rendered for each."""
    cells = [
        (f"{name}, seed {seed}", *(median_cell([run.get(c)]) for c in COLUMNS))
        for name, runs in rows.items()
        for seed, run in enumerate(runs)
    ]
    several = len(cells) > len(rows)
    return [Table(("", *COLUMNS), tuple(cells), "Each seed")] if several else []


def measure(job: Values, seed: int) -> Metrics:
    """Metrics of one run with these settings of loop closure, without refinement."""
    kind, place, _ = source_of(job["sequence"], seed)
    settings = validated(
        RunSettings,
        {
            "dataset": {"kind": kind, "path": str(place)},
            "image_size": job["image_size"],
            "mapping": {"final_iterations": 0},
            "loops": job["loops"],
            "seed": seed,
        },
    )
    dataset = open_dataset(kind, place, settings.image_size)
    with finished_slam(settings, dataset) as run:
        return run.metrics | {
            "edges": len(run.result.loops),
            "edges_false": false_edges(run.result, dataset),
        }


def false_edges(result: SlamResult, dataset: Dataset) -> int:
    """Loop edges that the truth contradicts."""
    assert dataset.ground_truth is not None
    anchors = [
        dataset.ground_truth.at(dataset[submap.keyframe_indices[0]].timestamp_s)
        for submap in result.submaps
    ]
    count = 0
    for loop in result.loops:
        T_world_first, T_world_second = anchors[loop.first], anchors[loop.second]
        assert T_world_first is not None and T_world_second is not None
        error = loop.residual(T_world_first, T_world_second)
        count += bool(np.linalg.norm(error[:3]) > LoopTruthOptions().max_distance_m)
    return count


if __name__ == "__main__":
    main()
