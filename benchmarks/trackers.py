"""Trackers beside each other: error, and how often each draws the map. No times.

    SEMSPLAT_DATA=DATA python -m benchmarks.trackers
    SEMSPLAT_DATA=DATA python -m benchmarks.trackers --table starts

"kinds": the dense tracker against the papers' first-order one. "starts": the dense tracker's
starts, where frames are left out of a recording so that the camera jumps.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

from benchmarks.machine import describe_machine
from toolkit.baselines.factory import build_tracker
from toolkit.datasets.registry import open_dataset
from toolkit.evaluation.trajectory import absolute_trajectory_error, relative_pose_error
from toolkit.mapping.factory import build_mapper
from toolkit.settings.mapping import MappingSettings
from toolkit.slam import Slam
from toolkit.tracking.options import DenseOptions, TrackingOptions


@dataclass(frozen=True)
class Options:
    """Compare trackers on real recordings."""

    table: Literal["kinds", "starts"] = "kinds"
    """What to compare."""
    only: tuple[str, ...] = ()
    """Names of sequences to run; all without it."""
    seed: int = 0
    """Of the mapper's choices."""


@dataclass(frozen=True)
class Sequence:
    """Frames of a recording.

    Attributes:
        kind, folder, image_size: as `semsplat run` takes them.
        until: frames before this one.
        every: every n-th of them.
        without: (first, last) frames left out, the last one not.
    """

    kind: str
    folder: str
    image_size: tuple[int, int] | None = None
    until: int | None = None
    every: int = 1
    without: tuple[int, int] = (0, 0)


RPY = Sequence("tum", "tum_fr1_rpy", (320, 240))
OFFICE = Sequence("replica", "replica_office0")
KITCHEN = Sequence("seven-scenes", "7scenes_redkitchen", (320, 240))

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
COLUMNS = ("ATE cm", "rotation RPE deg", "frames", "lost", "renders a frame", "most")


def main() -> None:
    """Print one row a sequence and tracker."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    print("\n| sequence | tracker | " + " | ".join(COLUMNS) + " |")
    print("|---|---|" + "---:|" * len(COLUMNS), flush=True)
    for name, sequence in SEQUENCES[options.table].items():
        if options.only and name not in options.only:
            continue
        for tracker, settings in TRACKERS[options.table].items():
            cells = _tracked(sequence, settings, options.seed)
            print(f"| {name} | {tracker} | " + " | ".join(cells) + " |", flush=True)


def _tracked(sequence: Sequence, settings: TrackingOptions, seed: int) -> list[str]:
    """Track and map the frames; the cells of a row."""
    path = Path(os.environ["SEMSPLAT_DATA"]) / sequence.folder
    dataset = open_dataset(sequence.kind, path, sequence.image_size, sequence.until)
    missing = range(*sequence.without)
    indices = [i for i in range(0, len(dataset), sequence.every) if i not in missing]
    mapping = MappingSettings(centred=settings.kind == "dense")
    mapper = build_mapper(mapping, np.random.default_rng(seed), "auto")
    slam = Slam(build_tracker(settings), mapper)
    renders = []
    for place, index in enumerate(tqdm(indices, file=sys.stderr, leave=False)):
        # Keyframes count frames: those left out are as if never taken.
        result = slam.process_frame(replace(dataset[index], index=place))
        if result.tracking is not None:
            renders.append(result.tracking.renders)
    assert dataset.ground_truth is not None
    error = absolute_trajectory_error(slam.trajectory, dataset.ground_truth)
    steps = relative_pose_error(slam.trajectory, dataset.ground_truth)
    return [
        f"{100 * error.rmse_m:.3f}",
        f"{steps.rotation_rmse_deg:.3f}" if steps else "n/a",
        str(len(indices)),
        str(len(slam.lost_frames)),
        f"{np.mean(renders):.2f}",
        str(max(renders)),
    ]


if __name__ == "__main__":
    main()
