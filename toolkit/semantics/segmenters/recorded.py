"""Labels that the data set recorded."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.frame import Frame


class RecordedLabels:
    """The label image that lies beside each frame; a frame without one is void.

    Args:
        class_names: the data set's names by id, without void.
    """

    def __init__(self, class_names: Mapping[int, str]) -> None:
        self.class_names = dict(class_names)

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """See Segmenter."""
        if frame.labels is None:
            return np.zeros(frame.depth_m.shape, np.int32)
        return frame.labels

    def state(self) -> dict[str, NDArray]:
        """See Segmenter."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """See Segmenter."""
