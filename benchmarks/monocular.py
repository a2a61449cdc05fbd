"""`semsplat run --depth none`: poses, depth and maps from colour alone.

SEMSPLAT_DATA=DATA python -m benchmarks.monocular [--only NAMES]
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass

import numpy as np
import tyro

from benchmarks.recordings import RECORDINGS, room, sequence_arguments
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import run_metrics
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import open_dataset
from toolkit.monocular.motion import estimate_motion
from toolkit.monocular.sequence import MonocularSequence

COLUMNS = (
    "ate_rmse_cm",
    "still_cm",
    "path_m",
    "ate_scale",
    "frames_lost",
    "psnr_db",
    "depth_density_percent",
    "depth_median_error_percent",
    "depth_outliers_percent",
    "monocular_reliable",
    "monocular_extent",
    "monocular_scale_sigma_percent",
    "monocular_revisits",
    "monocular_reprojection_px",
    "monocular_keyframes",
    "gaussians",
    "motion_ms_per_frame",
    "total_ms_per_frame",
    "frames",
    "peak_memory_mb",
)
OFFICE, EUROC, ROOM, NOISY = "office0", "EuRoC V1_01", "room", "room, sensor noise"
# The sequence of each row, and further options of its run.
ROWS: dict[str, list[str]] = {
    OFFICE: ["office0"],
    EUROC: ["euroc"],
    ROOM: ["room"],
    NOISY: ["room-noise"],
    "RedKitchen": ["redkitchen"],
    "HoloLens walk": ["hololens"],
    "fr1/rpy": ["fr1_rpy"],
}
_OUTLIER = 0.2
_DEPTH_VIEWS = 12
DESCRIPTION = f"""\
`semsplat run --depth none` with default settings: true depth is used for the evaluation alone.
RedKitchen and fr1/rpy have 320x240 pixels, the rooms 320x240, office0 600x340, EuRoC 752x480
(grey), the HoloLens walk 540x360. ATE of all frames after Sim(3) alignment; beside it, the RMS
distance of the camera from its mean position, which is the ATE of a camera that never moves.
Depth of {_DEPTH_VIEWS} evenly spaced keyframes at the scale of the alignment: fraction of the
pixels with true depth that have an estimated one, its median relative error, and the fraction
with an error above {_OUTLIER:.0%}. The motion of the whole sequence is estimated before it is
mapped (`motion_ms_per_frame`, part of the total)."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Run every sequence without depth."""

    extra: str = ""
    """Further options of every run, in one string."""
    name: str = "monocular"
    """Name of the results file; give another one with --extra."""


def main() -> None:
    """Measure one row for each sequence."""
    options = tyro.cli(Options)
    report = Report(options.name, "Without depth", DESCRIPTION, options, range(1))
    extra = shlex.split(options.extra)
    rows = report.measured({name: [*row, *extra] for name, row in ROWS.items()}, measure)
    tables = [table_of(COLUMNS, rows, "sequence")]
    report.write(*tables, *([] if extra else [target_table(targets(rows))]))


def measure(job: list[str], seed: int) -> Metrics:
    """Run one sequence, and evaluate the depth of its keyframes."""
    sequence, *options = job
    metrics = run_metrics([*sequence_arguments(sequence), "--depth", "none", *options], seed)
    dataset = _opened(sequence)
    metrics |= _path(dataset)
    scale = metrics.get("ate_scale")
    if isinstance(scale, float):
        metrics |= _depth(dataset, scale)
    return metrics


def _opened(sequence: str) -> RecordedDataset:
    recording = RECORDINGS.get(sequence)
    if recording is None:
        return open_dataset("synthetic", room(sequence))
    return open_dataset(recording.kind, recording.path, recording.image_size, needs_depth=False)


def _path(dataset: RecordedDataset) -> Metrics:
    truth = dataset.ground_truth
    if truth is None:
        return {}
    centres = truth.T_world_camera[:, :3, 3]
    still = np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean())
    length = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
    return {"still_cm": 100.0 * float(still), "path_m": float(length)}


def _depth(dataset: RecordedDataset, scale: float) -> Metrics:
    """Density and errors of the depth of some keyframes."""
    if dataset.files(0).depth is None:
        return {}
    motion = estimate_motion(dataset, dataset.camera)
    sequence = MonocularSequence(dataset, motion)
    known, measured, errors = 0, 0, []
    for number in np.unique(np.linspace(0, len(motion.views) - 1, _DEPTH_VIEWS).astype(int)):
        index = motion.views[number].frame
        depth, true = scale * sequence[index].depth_m, dataset[index].depth_m
        both = (depth > 0) & (true > 0)
        known, measured = known + int(both.sum()), measured + int((true > 0).sum())
        errors.append(np.abs(depth[both] / true[both] - 1.0))
    error = np.concatenate(errors)
    return {
        "depth_density_percent": 100.0 * known / measured,
        "depth_median_error_percent": 100.0 * float(np.median(error)),
        "depth_outliers_percent": 100.0 * float((error > _OUTLIER).mean()),
    }


def targets(rows: Rows) -> list[Target]:
    """What the default settings should reach."""
    median = median_of(rows)
    path = median(ROOM, "path_m")
    most = None if path is None else 100.0 * path
    return [
        Target("office0, ATE in cm", median(OFFICE, "ate_rmse_cm"), at_most=2.0),
        Target("office0, ATE in cm, stretch", median(OFFICE, "ate_rmse_cm"), at_most=1.0),
        Target("EuRoC, ATE in cm", median(EUROC, "ate_rmse_cm"), at_most=5.0),
        *(
            []
            if most is None
            else [
                Target("room, ATE in cm (1 %)", median(ROOM, "ate_rmse_cm"), at_most=0.01 * most),
                Target("noisy room, ATE (2 %)", median(NOISY, "ate_rmse_cm"), at_most=0.02 * most),
            ]
        ),
        Target("room, PSNR in dB", median(ROOM, "psnr_db"), at_least=30.0),
    ]


if __name__ == "__main__":
    main()
