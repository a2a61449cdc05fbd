"""`semsplat run` with its default settings on every sequence.

    SEMSPLAT_DATA=DATA python -m benchmarks.accuracy.sequences [--seeds 3] [--only NAMES]

Each run is a process of its own. A row is the median over its seeds, for times too.
"""

from __future__ import annotations

from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.runner import Page
from benchmarks.shared.runs import run_metrics
from benchmarks.shared.tables import Metrics, Rows, Target, median_of, table_of, targets_of

COLUMNS = (
    *("trajectory.ate_rmse_cm", "trajectory.rpe_rotation_deg", "frames.lost"),
    *("images.mapped.psnr_db", "images.mapped.psnr_measured_db", "images.mapped.psnr_one_gain_db"),
    *("images.unseen.psnr_db", "images.unseen_refined.psnr_db", "images.mapped.ssim"),
    *("depth.mapped.l1_cm", "map.free_space.opacity_percent", "semantics.mapped.miou_percent"),
    *("semantics.unseen.miou_percent", "loops.verified.overlap.precision_percent"),
    *("loops.verified.overlap.recall_percent", "loops.verified.overlap.searched_with_truth"),
    *("map.gaussians", "time.tracking_ms_per_frame", "time.labelling_ms_per_frame"),
    *("time.mapping_ms_per_frame", "time.refinement_ms_per_frame", "frames.total"),
    "memory.peak_mb",
)
_ATE, _MAPPED = "trajectory.ate_rmse_cm", "images.mapped.psnr_db"
_REFINED, _EMPTY = "images.unseen_refined.psnr_db", "map.free_space.opacity_percent"
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
    at_most = (
        ("RedKitchen, ATE in cm", KITCHEN, _ATE, 2.1),
        ("fr1/rpy, ATE in cm", RPY, _ATE, 1.3),
        ("HoloLens walk, ATE in cm", WALK, _ATE, 8.0),
        ("HoloLens walk, opacity in empty space in %", WALK, _EMPTY, 1.0),
        ("office0 tracked, ATE in cm", OFFICE, _ATE, 0.3),
        ("room, ATE in cm", ROOM, _ATE, 0.3),
        ("room with sensor noise, ATE in cm", NOISY, _ATE, 1.0),
        ("room, depth L1 in cm", ROOM, "depth.mapped.l1_cm", 0.5),
        ("office0, poses given, depth L1 in cm", GIVEN, "depth.mapped.l1_cm", 0.25),
        ("office0, poses given, Gaussians", GIVEN, "map.gaussians", 800_000),
    )
    at_least = (
        ("HoloLens walk, mapped views in dB", WALK, _MAPPED, 18.0),
        ("room, mapped views in dB", ROOM, _MAPPED, 37.0),
        ("room, unseen views with refined poses in dB", ROOM, _REFINED, 34.0),
        ("office0, poses given, mapped dB", GIVEN, _MAPPED, 40.5),
        ("office0, poses given, held-out dB", GIVEN, "images.unseen.psnr_db", 37.5),
    )
    label = "office0, poses given, minutes of mapping and refinement"
    found = targets_of(rows, at_most=at_most, at_least=at_least)
    return [*found, Target(label, minutes, at_most=5.0)]


PAGE = Page(
    "sequences",
    "Sequences",
    DESCRIPTION,
    ROWS,
    measure,
    lambda rows: [table_of(COLUMNS, rows, "sequence")],
    targets,
)

if __name__ == "__main__":
    PAGE.main()
