"""`semsplat run` with its default settings on every sequence.

    SEMSPLAT_DATA=DATA python -m benchmarks.sequences [--seeds 3] [--only NAMES]

Each run is a process of its own. A row is the median over its seeds, for times too.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass

import tyro

from benchmarks.recordings import sequence_arguments
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import run_metrics
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table

COLUMNS = (
    "trajectory.ate_rmse_cm",
    "trajectory.rpe_rotation_deg",
    "frames.lost",
    "images.mapped.psnr_db",
    "images.mapped.psnr_measured_db",
    "images.mapped.psnr_one_gain_db",
    "images.unseen.psnr_db",
    "images.unseen_refined.psnr_db",
    "images.mapped.ssim",
    "depth.mapped.l1_cm",
    "map.free_space.opacity_percent",
    "semantics.mapped.miou_percent",
    "semantics.unseen.miou_percent",
    "loops.verified.overlap.precision_percent",
    "loops.verified.overlap.recall_percent",
    "loops.verified.overlap.searched_with_truth",
    "map.gaussians",
    "time.tracking_ms_per_frame",
    "time.labelling_ms_per_frame",
    "time.mapping_ms_per_frame",
    "time.refinement_ms_per_frame",
    "frames.total",
    "memory.peak_mb",
)
KITCHEN, RPY, OFFICE = "7-Scenes RedKitchen", "TUM fr1/rpy", "Replica office0"
GIVEN = "Replica office0, poses given"
WALK = "HoloLens walk"
ROOM, NOISY = "synthetic room", "synthetic room, sensor noise"
DESCRIPTION = """\
`semsplat run` with default settings: labels recorded with the dataset, or those of planes on
RedKitchen, fr1/rpy and the HoloLens walk. RedKitchen and fr1/rpy are resized to 320x240, the
HoloLens walk to 270x180, office0 has 600x340 pixels, the rooms (`semsplat make-room`, with and
without `--sensor-noise`) 320x240. ATE after SE(3) alignment; PSNR is the mean over views of the
dB over all pixels, of at most 100 evenly spaced views. Unseen views of office0 are every fifth
frame, those of the HoloLens walk every tenth, those of the rooms lie off the path; "refined" ones
have their poses refined on the map. Loop recall is over the searched keyframes with a true loop
before them (`loops.verified.overlap.searched_with_truth`). Times are milliseconds per frame; the
refinement of the whole map at the end is spread over the frames."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Run every sequence."""

    seeds: int = 1
    """Seeds 0, 1, ... of each sequence."""
    extra: str = ""
    """Further options of every run, in one string."""
    name: str = "sequences"
    """Name of the results file; give another one with --extra."""


# The sequence of each row, and further options of its run.
ROWS: dict[str, list[str]] = {
    KITCHEN: ["redkitchen"],
    RPY: ["fr1_rpy"],
    OFFICE: ["office0"],
    GIVEN: ["office0", "--poses", "given", "--hold-out", "5"],
    # Held-out frames show what space is empty.
    WALK: ["hololens", "--image-size", "270", "180", "--hold-out", "10"],
    ROOM: ["room"],
    NOISY: ["room-noise"],
}


def main() -> None:
    """Measure one row for each sequence."""
    options = tyro.cli(Options)
    extra = shlex.split(options.extra)
    if extra and options.name == Options.name:
        raise SystemExit("--extra changes what is measured; give the results a --name of their own")
    report = Report(options.name, "Sequences", DESCRIPTION, options, range(options.seeds))
    jobs = {
        name: [*row, *extra]
        for name, row in ROWS.items()
        if not (extra and options.only) or name in options.only
    }
    rows = report.measured(jobs, measure)
    tables = [table_of(COLUMNS, rows, "sequence")]
    report.write(*tables, *([] if extra else [target_table(targets(rows))]))


def measure(job: list[str], seed: int) -> Metrics:
    """Run one sequence."""
    sequence, *options = job
    return run_metrics([*sequence_arguments(sequence), *options], seed)


def targets(rows: Rows) -> list[Target]:
    """What the default settings should reach."""
    median = median_of(rows)
    times = [
        median(GIVEN, f"time.{stage}_ms_per_frame")
        for stage in ("tracking", "mapping", "refinement")
    ]
    frames = median(GIVEN, "frames.total")
    minutes = None
    if frames is not None and None not in times:
        minutes = frames * sum(time for time in times if time is not None) / 60e3
    return [
        Target("RedKitchen, ATE in cm", median(KITCHEN, "trajectory.ate_rmse_cm"), at_most=2.1),
        Target("fr1/rpy, ATE in cm", median(RPY, "trajectory.ate_rmse_cm"), at_most=1.3),
        Target("HoloLens walk, ATE in cm", median(WALK, "trajectory.ate_rmse_cm"), at_most=8.0),
        Target(
            "HoloLens walk, mapped views in dB",
            median(WALK, "images.mapped.psnr_db"),
            at_least=18.0,
        ),
        Target(
            "HoloLens walk, opacity in empty space in %",
            median(WALK, "map.free_space.opacity_percent"),
            at_most=1.0,
        ),
        Target("office0 tracked, ATE in cm", median(OFFICE, "trajectory.ate_rmse_cm"), at_most=0.3),
        Target("room, ATE in cm", median(ROOM, "trajectory.ate_rmse_cm"), at_most=0.3),
        Target(
            "room with sensor noise, ATE in cm",
            median(NOISY, "trajectory.ate_rmse_cm"),
            at_most=1.0,
        ),
        Target("room, mapped views in dB", median(ROOM, "images.mapped.psnr_db"), at_least=37.0),
        Target(
            "room, unseen views with refined poses in dB",
            median(ROOM, "images.unseen_refined.psnr_db"),
            at_least=34.0,
        ),
        Target("room, depth L1 in cm", median(ROOM, "depth.mapped.l1_cm"), at_most=0.5),
        Target(
            "office0, poses given, mapped dB", median(GIVEN, "images.mapped.psnr_db"), at_least=40.5
        ),
        Target(
            "office0, poses given, held-out dB",
            median(GIVEN, "images.unseen.psnr_db"),
            at_least=37.5,
        ),
        Target(
            "office0, poses given, depth L1 in cm",
            median(GIVEN, "depth.mapped.l1_cm"),
            at_most=0.25,
        ),
        Target("office0, poses given, Gaussians", median(GIVEN, "map.gaussians"), at_most=800_000),
        Target("office0, poses given, minutes of mapping and refinement", minutes, at_most=5.0),
    ]


if __name__ == "__main__":
    main()
