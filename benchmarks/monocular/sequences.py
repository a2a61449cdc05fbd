"""`semsplat run --depth none`: poses, depth and maps from colour alone.

SEMSPLAT_DATA=DATA python -m benchmarks.monocular.sequences [--only NAMES]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.monocular.runs import DEPTH_VIEWS, OUTLIER, measure
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Rows, Table, Target, median_of, table_of, worst_of, worst_table

COLUMNS = (
    *("ate_rmse_cm", "still_cm", "path_m", "trajectory.scale", "rotation_rms_deg", "frames.lost"),
    *("images.mapped.psnr_db", "depth.mapped.coverage_percent", "depth_density_percent"),
    *("depth_median_error_percent", "depth_outliers_percent", "focal_error_percent"),
)
RELIABILITY = (
    *("monocular.reliable", "monocular.doubts", "monocular.extent"),
    *("monocular.scale_sigma_percent", "monocular.reprojection_px", "monocular.keyframes"),
    "monocular.focal_sigma_percent",
)
REVISITS = ("monocular.revisits", "monocular.revisits_rejected", "scale_drift_percent")
COST = (
    *("monocular.motion_ms_per_frame", "time.tracking_ms_per_frame", "time.mapping_ms_per_frame"),
    *("time.refinement_ms_per_frame", "time.online_ms_per_frame", "time.total_ms_per_frame"),
    *("map.gaussians", "frames.total", "memory.peak_mb"),
)
WORST = {
    "ate_rmse_cm": max,
    "rotation_rms_deg": max,
    "frames.lost": max,
    "images.mapped.psnr_db": min,
    "depth_density_percent": min,
    "depth_median_error_percent": max,
    "depth_outliers_percent": max,
    "focal_error_percent": max,
    "scale_drift_percent": max,
}
OFFICE, EUROC, ROOM, NOISY = "office0", "EuRoC V1_01", "room", "room, sensor noise"
RING, STILL, RPY = "ring", "hardly moving", "fr1/rpy"


# The sequence of each row, and whether the run is given a film without intrinsics instead.
_SEQUENCES = {
    OFFICE: "office0",
    EUROC: "euroc",
    ROOM: "room",
    NOISY: "room-noise",
    "room, plain walls, sensor noise": "room-plain",
    RING: "ring-ideal",
    "around objects": "orbit",
    STILL: "still",
    "RedKitchen": "redkitchen",
    "HoloLens walk": "hololens",
    "HoloLens walk, 270x180": "hololens-small",
    "walk through rooms": "walk",
    "fast walk through rooms": "walk-fast",
    RPY: "fr1_rpy",
}
_FILMS = {"office0, film": "office0", "EuRoC V1_01, film": "euroc", "objects, film": "phone"}
ROWS: dict[str, dict[str, Any]] = {
    **{n: {"sequence": s, "options": [], "film": False} for n, s in _SEQUENCES.items()},
    **{n: {"sequence": s, "options": [], "film": True} for n, s in _FILMS.items()},
}
DESCRIPTION = f"""\
`semsplat run --depth none` with default settings: true depth is used for the evaluation alone.
Medians over the seeds. For the synthetic sequences, each seed is another room with another camera
path; for recordings it is that of the mapper, while the motion is the same. Films are the same
images in an .mp4 without intrinsics. RedKitchen, fr1/rpy and the synthetic sequences have 320x240
pixels, office0 600x340, EuRoC 752x480 (grey), the HoloLens walk 540x360, the film of objects
360x640.

ATE of all frames after Sim(3) alignment; `still_cm` is the RMS distance of the camera from its mean
position, which is the ATE of a camera that never moves. Rotation: RMS after alignment of the
orientations; none for EuRoC, whose file of true poses has inverted rotations. Depth of
{DEPTH_VIEWS} evenly spaced keyframes at the scale of the alignment: fraction of the pixels with
true depth that have an estimated one, its median relative error, and the fraction with an error
above {OUTLIER:.0%}. Drift of the scale: its change from the first quarter of the frames to the last
one; it means little where the camera hardly moves. The motion of the whole sequence is estimated
before it is mapped (`monocular.motion_ms_per_frame`, part of the total)."""


def _tables(rows: Rows) -> Sequence[Table]:
    return (
        table_of(COLUMNS, rows, "sequence"),
        worst_table(WORST, rows, "sequence", "Worst seed"),
        table_of(RELIABILITY, rows, "sequence", "Reliability"),
        table_of(REVISITS, rows, "sequence", "Revisits"),
        table_of(COST, rows, "sequence", "Time and memory"),
    )


def targets(rows: Rows) -> list[Target]:
    """What the default settings should reach."""
    median = median_of(rows)

    def ate(row: str) -> float | None:
        return median(row, "ate_rmse_cm")

    def ate_percent(row: str) -> float | None:
        """ATE relative to the length of the path."""
        error, path = ate(row), median(row, "path_m")
        return None if error is None or not path else error / path

    def reliable(row: str) -> float | None:
        return worst_of(rows.get(row, ()), "monocular.reliable", max)

    return [
        Target("office0, ATE in cm", ate(OFFICE), at_most=2.0),
        Target("office0, ATE in cm, stretch", ate(OFFICE), at_most=1.0),
        Target("EuRoC, ATE in cm", ate(EUROC), at_most=5.0),
        Target("room, ATE in % of the path", ate_percent(ROOM), at_most=1.0),
        Target("noisy room, ATE in % of the path", ate_percent(NOISY), at_most=2.0),
        Target("room, PSNR in dB", median(ROOM, "images.mapped.psnr_db"), at_least=30.0),
        Target("ring, drift of scale in %", median(RING, "scale_drift_percent"), at_most=2.0),
        Target("hardly moving camera, called reliable (0: no)", reliable(STILL), at_most=0.0),
        Target("fr1/rpy, called reliable (0: no)", reliable(RPY), at_most=0.0),
    ]


PAGE = Page("monocular", "Without depth", DESCRIPTION, ROWS, measure, _tables, targets, seeds=3)

if __name__ == "__main__":
    PAGE.main()
