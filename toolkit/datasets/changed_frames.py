"""A dataset whose frames are changed when they are read."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator

from toolkit.base.frame import Frame
from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched


class ChangedFrames(ABC):
    """The frames of another dataset, each changed; any thread may read them.

    Implements `Dataset`.

    Args:
        dataset: the frames.
    """

    def __init__(self, dataset: Dataset) -> None:
        self.name, self.camera = dataset.name, dataset.camera
        self.ground_truth, self.label_names = dataset.ground_truth, dataset.label_names
        self._dataset = dataset
        # Frames are read by a thread of their own, and by whoever asks for one.
        self._reading = threading.Lock()

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame:
        with self._reading:
            return self._changed(self._dataset[index])

    def __iter__(self) -> Iterator[Frame]:
        return prefetched(self, range(len(self)))

    @abstractmethod
    def _changed(self, frame: Frame) -> Frame:
        """Return a frame as this dataset has it; no other thread calls it at the same time."""
