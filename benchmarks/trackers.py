"""Trackers compared: error, and how often each renders the map. No times.

SEMSPLAT_DATA=DATA python -m benchmarks.trackers
SEMSPLAT_DATA=DATA python -m benchmarks.trackers --table starts
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

from benchmarks.recordings import RECORDINGS
from benchmarks.report import Report, ReportOptions
from benchmarks.tables import Metrics, table_of
from toolkit.datasets.registry import open_dataset
from toolkit.evaluation.trajectory import absolute_trajectory_error, relative_pose_error
from toolkit.mapping.mapper import Mapper
from toolkit.mapping.options import MapperOptions
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.system import Slam
from toolkit.tracking.factory import build_tracker
from toolkit.tracking.options import DenseOptions, TrackingOptions

DESCRIPTIONS = {
    "kinds": "The dense tracker and the papers' first-order tracker, without loops.",
    "starts": "Initial estimates of the dense tracker. Frames are left out of a recording, so that "
    "the camera jumps.",
}


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Compare trackers on real recordings."""

    table: Literal["kinds", "starts"] = "kinds"
    """What to compare."""


@dataclass(frozen=True)
class Sequence:
    """Frames of a recording.

    Attributes:
        name: a key of RECORDINGS.
        until: frames before this one.
        every: every n-th of them.
        without: first frame left out, and the first one after that is not.
    """

    name: str
    until: int | None = None
    every: int = 1
    without: tuple[int, int] = (0, 0)


RPY, OFFICE, KITCHEN = Sequence("fr1_rpy"), Sequence("office0"), Sequence("redkitchen")

SEQUENCES = {
    "kinds": {
        "fr1_rpy": RPY,
        "office0": OFFICE,
        "RedKitchen, 60 frames": replace(KITCHEN, until=60),
    },
    "starts": {
        "fr1_rpy": RPY,
        "fr1_rpy, every 2nd": replace(RPY, every=2),
        "fr1_rpy, every 5th": replace(RPY, every=5),
        "fr1_rpy, 40-49 missing": replace(RPY, without=(40, 50)),
        "fr1_rpy, 60-74 missing": replace(RPY, without=(60, 75)),
        "office0": OFFICE,
        "office0, every 2nd": replace(OFFICE, every=2),
        "RedKitchen": KITCHEN,
        "RedKitchen, every 4th": replace(KITCHEN, every=4),
        "RedKitchen, every 8th": replace(KITCHEN, every=8),
    },
}
TRACKERS = {
    "kinds": {"dense": TrackingOptions(), "first-order": TrackingOptions(kind="first-order")},
    "starts": {
        "velocity": TrackingOptions(dense=DenseOptions(start="velocity")),
        "auto": TrackingOptions(dense=DenseOptions(start="auto")),
        "both": TrackingOptions(dense=DenseOptions(start="both")),
    },
}
COLUMNS = (
    "ate_rmse_cm",
    "rpe_rotation_deg",
    "frames",
    "frames_lost",
    "renders_per_frame",
    "renders_max",
)


def main() -> None:
    """Measure one row for each sequence and tracker."""
    options = tyro.cli(Options)
    table = options.table
    name, title = f"trackers-{table}", f"Trackers: {table}"
    report = Report(name, title, DESCRIPTIONS[table], options)
    jobs = {
        f"{sequence}, {tracker}": [table, sequence, tracker]
        for sequence in SEQUENCES[table]
        for tracker in TRACKERS[table]
    }
    report.write(table_of(COLUMNS, report.measured(jobs, measure)))


def measure(job: list[str], seed: int) -> Metrics:
    """Track and map the frames."""
    table, name, tracker = job
    sequence, settings = SEQUENCES[table][name], TRACKERS[table][tracker]
    recording = RECORDINGS[sequence.name]
    dataset = open_dataset(recording.kind, recording.path, recording.image_size, sequence.until)
    missing = range(*sequence.without)
    indices = [i for i in range(0, len(dataset), sequence.every) if i not in missing]
    mapping = MapperOptions(centred=settings.kind == "dense")
    mapper = Mapper(mapping, np.random.default_rng(seed), "auto")
    slam = Slam(FrontEnd(build_tracker(settings)), mapper)
    renders = []
    for place, index in enumerate(tqdm(indices, file=sys.stderr, leave=False)):
        # Keyframes count frames: those left out are as if never taken.
        result = slam.process_frame(replace(dataset[index], index=place))
        if result.tracking is not None:
            renders.append(result.tracking.renders)
    assert dataset.ground_truth is not None
    state = slam.result()
    error = absolute_trajectory_error(state.trajectory, dataset.ground_truth)
    steps = relative_pose_error(state.trajectory, dataset.ground_truth)
    return {
        "ate_rmse_cm": 100 * error.rmse_m,
        "rpe_rotation_deg": steps.rotation_rmse_deg if steps else None,
        "frames": len(indices),
        "frames_lost": len(state.lost_frames),
        "renders_per_frame": float(np.mean(renders)),
        "renders_max": max(renders),
    }


if __name__ == "__main__":
    main()
