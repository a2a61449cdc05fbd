"""A dataset without its depth."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched
from toolkit.frame import Frame
from toolkit.geometry.camera import Camera


class ImagesOnly:
    """The frames of a dataset without depth; any thread may read them.

    Implements `Dataset`.

    Args:
        dataset: the recording; its depth is ignored.
        camera: other intrinsics than those of the recording; None for the same.
    """

    def __init__(self, dataset: Dataset, camera: Camera | None = None) -> None:
        self.name, self.camera = dataset.name, camera or dataset.camera
        self.ground_truth, self.label_names = dataset.ground_truth, dataset.label_names
        self._dataset = dataset
        # Frames are read by a thread of their own, and by the source of depth priors.
        self._reading = threading.Lock()

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame:
        with self._reading:
            frame = self._dataset[index]
        return replace(frame, depth_m=np.zeros_like(frame.depth_m), camera=self.camera)

    def __iter__(self) -> Iterator[Frame]:
        return prefetched(self, range(len(self)))
