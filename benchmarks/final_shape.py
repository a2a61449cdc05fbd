"""Finished maps of spheres and of ellipsoids: quality on unseen views, size, time.

    SEMSPLAT_DATA=DATA python -m benchmarks.final_shape [--only NAMES]

Each run is a process of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from benchmarks.recordings import sequence_arguments
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import run_metrics
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table

UNSEEN, MAPPED = "images.unseen.psnr_db", "images.mapped.psnr_db"
COUNT, REFINEMENT = "map.gaussians", "time.refinement_ms_per_frame"
COLUMNS = (
    UNSEEN,
    "images.unseen.ssim",
    "depth.unseen.l1_cm",
    MAPPED,
    "semantics.unseen.miou_percent",
    COUNT,
    REFINEMENT,
    "time.total_ms_per_frame",
)
_KITCHEN = ["redkitchen", "--max-frames", "60", "--hold-out", "5"]
SEQUENCES: dict[str, list[str]] = {
    "RedKitchen": _KITCHEN,
    "RedKitchen 640x480": ["redkitchen-native", *_KITCHEN[1:]],
    "fr1/rpy": ["fr1_rpy", "--hold-out", "10"],
    "office0, poses given": ["office0", "--poses", "given", "--hold-out", "5"],
    "HoloLens walk": ["hololens", "--image-size", "270", "180", "--hold-out", "10"],
    "room": ["room"],
    "room, sensor noise": ["room-noise"],
}
SHAPES = ("spheres", "ellipsoids")
DESCRIPTION = """\
`semsplat run` with each `--mapping.final-shape`, otherwise default settings; only the refinement
at the end differs. Unseen views are every fifth frame (RedKitchen, 60 frames; office0) or every
tenth one (fr1/rpy, HoloLens walk), and views off the path in the rooms. Targets compare ellipsoids
with spheres."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Run every sequence with both shapes."""


def main() -> None:
    """Measure one row for each sequence and shape."""
    report = Report("final_shape", "Final shape", DESCRIPTION, tyro.cli(Options))
    jobs = {
        f"{name}, {shape}": [*arguments, "--mapping.final-shape", shape]
        for name, arguments in SEQUENCES.items()
        for shape in SHAPES
    }
    rows = report.measured(jobs, measure)
    report.write(table_of(COLUMNS, rows, "sequence, shape"), target_table(targets(rows)))


def measure(job: list[str], seed: int) -> Metrics:
    """Run one sequence."""
    sequence, *options = job
    return run_metrics([*sequence_arguments(sequence), *options], seed)


def targets(rows: Rows) -> list[Target]:
    """What ellipsoids should reach."""
    median = median_of(rows)

    def compared(name: str, metric: str, difference: bool = False) -> float | None:
        spheres, ellipsoids = (median(f"{name}, {shape}", metric) for shape in SHAPES)
        if spheres is None or ellipsoids is None:
            return None
        return ellipsoids - spheres if difference else ellipsoids / spheres

    found = []
    for name in SEQUENCES:
        least = 1.0 if name == "RedKitchen" else 0.0
        gain, size = compared(name, UNSEEN, difference=True), compared(name, COUNT)
        found += [
            Target(f"{name}, unseen PSNR, dB more", gain, at_least=least),
            Target(f"{name}, Gaussians", size, at_most=0.5),
            Target(f"{name}, refinement time", compared(name, REFINEMENT), at_most=1.3),
        ]
    office = "office0, poses given, ellipsoids"
    unseen, mapped = median(office, UNSEEN), median(office, MAPPED)
    gap = None if unseen is None or mapped is None else mapped - unseen
    return [*found, Target("office0, mapped above unseen, dB", gap, at_most=1.0)]


if __name__ == "__main__":
    main()
