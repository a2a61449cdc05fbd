"""Maps the first half of a sequence and locates the second half on the frozen map.

SEMSPLAT_DATA=DATA python -m benchmarks.returning_frames
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.recordings import RECORDINGS
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Table
from toolkit.base.geometry import se3
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.images import psnr_db
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.depth_filter import DepthFilter
from toolkit.slam.tracking.placement import KeyframePlacement
from toolkit.splatting.rendering import render

DESCRIPTION = """\
RedKitchen moves along a kitchen and back: the frames of the way back are located on the map of the
way out and rendered there, at their own exposure. 320x240 pixels."""


@dataclass(frozen=True)
class Options:
    """Locate returning frames."""

    out: Path = RESULTS
    """Folder of the results file."""


def main() -> None:
    """Measure how many frames are located, and their PSNR."""
    options = tyro.cli(Options)
    header = current_header([0])
    recording = RECORDINGS["redkitchen"]
    dataset = open_dataset(recording.kind, recording.path, recording.image_size)
    half = len(dataset) // 2
    tracker = DenseTracker()
    slam = Slam(FrontEnd(tracker, placement=KeyframePlacement()), Mapper())
    for index in range(half):
        slam.process_frame(dataset[index])
    gaussians = slam.finish().gaussians
    back = DenseTracker()
    back.restore(tracker.state())
    depth_filter = DepthFilter()
    values, lost = [], 0
    for index in range(half, len(dataset)):
        frame = dataset[index]
        result = back.track(depth_filter.of(frame), gaussians)
        if result.lost:
            lost += 1
            continue
        drawn = render(gaussians, frame.camera, se3.inverse(result.T_map_camera))
        values.append(psnr_db(result.exposure.undo(drawn.colour), frame.rgb))
    row = ("RedKitchen", str(len(values)), str(lost), f"{np.mean(values):.2f}")
    table = Table(("sequence", "located", "lost", "PSNR dB"), (row,))
    title = "Returning frames"
    publish(Results("returning-frames", title, DESCRIPTION, header, (table,)), options.out)


if __name__ == "__main__":
    main()
