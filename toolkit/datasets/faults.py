"""Frames whose files cannot be read: a run continues without them."""

from __future__ import annotations

import numpy as np

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.prefetch import Frames

# So many unreadable frames in a row are no accident.
_MAX_IN_A_ROW = 10


def fault_tolerant(dataset: Dataset) -> Frames:
    """The frames of a recording without the errors of those that cannot be read.

    Other datasets read recordings in an order of their own, and are returned as they are.
    """
    return FaultTolerant(dataset) if isinstance(dataset, RecordedDataset) else dataset


class FaultTolerant:
    """The frames of a recording; those that cannot be read have a `fault` and empty images.

    Args:
        dataset: must be read in order.
    """

    def __init__(self, dataset: RecordedDataset) -> None:
        self._dataset = dataset
        self._in_a_row = 0

    def __getitem__(self, index: int) -> Frame:
        """Load a frame.

        Raises:
            DatasetError: it is the first frame, or ten in a row cannot be read.
        """
        try:
            frame = self._dataset[index]
        except DatasetError as error:
            self._in_a_row += 1
            if index == 0 or self._in_a_row == _MAX_IN_A_ROW:
                raise
            return self._empty(index, str(error))
        self._in_a_row = 0
        return frame

    def _empty(self, index: int, fault: str) -> Frame:
        camera, time_s = self._dataset.camera, self._dataset.files(index).timestamp_s
        size = camera.height, camera.width
        rgb, depth_m = np.zeros((*size, 3), np.float32), np.zeros(size, np.float32)
        return Frame(index, time_s, rgb, depth_m, camera, fault=fault)
