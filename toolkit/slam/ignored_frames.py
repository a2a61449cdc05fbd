"""The frames of a dataset without what a run ignores, for comparisons with its map."""

from __future__ import annotations

import numpy as np

from toolkit.base.frame import Frame, without_pixels
from toolkit.datasets.base import Dataset
from toolkit.datasets.changed_frames import ChangedFrames
from toolkit.semantics.segmenters.dataset_labels import RecordedLabels
from toolkit.slam.frame_preparation import FrameSources


class FramesWithoutIgnored(ChangedFrames):
    """The frames of a dataset, which are ignored where --semantics.ignore says so.

    Args:
        dataset: the frames.
        sources: find what the run ignores in a frame.
    """

    def __init__(self, dataset: Dataset, sources: FrameSources) -> None:
        super().__init__(dataset)
        self._sources = sources

    def _changed(self, frame: Frame) -> Frame:
        labeller, masks = self._sources.labeller, self._sources.ignored
        ignored = None
        if labeller is not None and labeller.every_frame:
            ignored = labeller.label(frame).ignored
        elif masks is not None:
            ignored = masks.pixels(frame, np.zeros(frame.depth_m.shape, bool))
        return frame if ignored is None else without_pixels(frame, ignored)

    def beside(self, others: Dataset) -> Dataset:
        """Other views of the same place, of which only labels of their own are known.

        Args:
            others: the views, with the class ids of the dataset.
        """
        labeller = self._sources.labeller
        if labeller is None or not isinstance(labeller.segmenter, RecordedLabels):
            return others
        return FramesWithoutIgnored(others, FrameSources(labeller.without_masks()))
