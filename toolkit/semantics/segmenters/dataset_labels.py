"""Labels of the dataset."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.semantics.segmenters.vocabulary import ClassVocabulary

_log = logging.getLogger(__name__)


class RecordedLabels:
    """Returns the labels of the frames after a check.

    Frames without a label image are void; the first one causes a warning.

    Args:
        names: the dataset's class names by id, without void.

    Raises:
        DatasetError: there are no names.
    """

    def __init__(self, names: Mapping[int, str]) -> None:
        self._vocabulary = ClassVocabulary(names, "the dataset's classes.json")
        self.place_divergence = 0.4
        self.class_names: Mapping[int, str] = self._vocabulary.names
        self._warned = False

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Return the frame's labels [H, W].

        Raises:
            DatasetError: an id has no name.
        """
        if frame.labels is None:
            if not self._warned:
                _log.warning(
                    "Frame %d has no label image; frames without one are treated as void.",
                    frame.index,
                )
                self._warned = True
            return np.zeros(frame.depth_m.shape, np.int32)
        self._vocabulary.check(frame.labels, f"the label image of frame {frame.index}")
        return frame.labels

    def state(self) -> dict[str, NDArray]:
        """Return an empty state: frames are labelled independently."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Accept an earlier `state`, which is empty."""
