"""A dataset without its depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import Dataset
from toolkit.datasets.changed_frames import ChangedFrames


class ImagesOnly(ChangedFrames):
    """The frames of a dataset without depth.

    Args:
        dataset: the recording; its depth is ignored.
        camera: other intrinsics than those of the recording; None for the same.
    """

    def __init__(self, dataset: Dataset, camera: Camera | None = None) -> None:
        super().__init__(dataset)
        self.camera = camera or dataset.camera

    def _changed(self, frame: Frame) -> Frame:
        return replace(frame, depth_m=np.zeros_like(frame.depth_m), camera=self.camera)
