"""Maps the first half of a sequence and shows the second half to the frozen map.

    SEMSPLAT_DATA=DATA python -m benchmarks.returning_frames

RedKitchen goes along a kitchen and comes back: the frames of the way back are located on
the map of the way out, and rendered there, at their own exposure.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from benchmarks.machine import describe_machine
from toolkit.datasets.registry import open_dataset
from toolkit.evaluation.images import psnr_db
from toolkit.geometry import se3
from toolkit.mapping.mapper import Mapper
from toolkit.registration.placement import KeyframePlacement
from toolkit.rendering import render
from toolkit.slam import Slam
from toolkit.tracking.dense import DenseTracker
from toolkit.tracking.depth_filter import DepthFilter


def main() -> None:
    """Print the share of frames located and their PSNR."""
    print(describe_machine())
    path = Path(os.environ["SEMSPLAT_DATA"]) / "7scenes_redkitchen"
    dataset = open_dataset("seven-scenes", path, (320, 240))
    half = len(dataset) // 2
    tracker = DenseTracker()
    slam = Slam(tracker, Mapper(), placement=KeyframePlacement())
    for index in range(half):
        slam.process_frame(dataset[index])
    slam.finish()
    gaussians = slam.mapper.gaussians
    # The finished map's colours fit pixels.
    back = DenseTracker(centred=False)
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
    print(f"returning frames: {len(values)} located, {lost} lost, PSNR {np.mean(values):.2f} dB")


if __name__ == "__main__":
    main()
