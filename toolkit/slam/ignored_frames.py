"""The frames of a dataset without what a run ignores, for comparisons with its map."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np

from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched
from toolkit.frame import Frame, without_pixels
from toolkit.semantics.segmenters.dataset_labels import RecordedLabels
from toolkit.slam.frame_preparation import FrameSources


class FramesWithoutIgnored:
    """The frames of a dataset, which are ignored where --semantics.ignore says so.

    Implements `Dataset`; any thread may read it.

    Args:
        dataset: the frames.
        sources: find what the run ignores in a frame.
    """

    def __init__(self, dataset: Dataset, sources: FrameSources) -> None:
        self.name, self.camera = dataset.name, dataset.camera
        self.ground_truth, self.label_names = dataset.ground_truth, dataset.label_names
        self._dataset, self._sources = dataset, sources
        self._reading = threading.Lock()

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame:
        with self._reading:
            frame = self._dataset[index]
            labeller, masks = self._sources.labeller, self._sources.ignored
            ignored = None
            if labeller is not None and labeller.every_frame:
                ignored = labeller.label(frame).ignored
            elif masks is not None:
                ignored = masks.pixels(frame, np.zeros(frame.depth_m.shape, bool))
        return frame if ignored is None else without_pixels(frame, ignored)

    def __iter__(self) -> Iterator[Frame]:
        return prefetched(self, range(len(self)))

    def beside(self, others: Dataset) -> Dataset:
        """Other views of the same place, of which only labels of their own are known.

        Args:
            others: the views, with the class ids of the dataset.
        """
        labeller = self._sources.labeller
        if labeller is None or not isinstance(labeller.segmenter, RecordedLabels):
            return others
        return FramesWithoutIgnored(others, FrameSources(labeller.without_masks()))
