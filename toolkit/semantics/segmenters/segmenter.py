"""Interface of segmenters, and frames without labels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame


class Segmenter(Protocol):
    """Labels every pixel of a frame with its own vocabulary.

    Attributes:
        place_divergence: KL divergence between the class histograms of two views, in nats,
            above which they are of different places. GauSem-SLAM uses 0.4 for many classes.
    """

    place_divergence: float

    @property
    def class_names(self) -> Mapping[int, str]:
        """Class names by id; ids start at 1, and 0 is void."""
        ...

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Return class ids [H, W], 0 where the class is unknown.

        Args:
            frame: the frame to label.
            T_map_camera: [4, 4] estimated or predicted pose of the frame, if known.

        Raises:
            DatasetError: required labels of the frame are missing or invalid.
        """
        ...

    def state(self) -> dict[str, NDArray]:
        """Return the arrays that `restore` accepts; empty for segmenters without state."""
        ...

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        ...


class Unlabelled:
    """Labels every pixel as void, for runs without semantics."""

    def __init__(self) -> None:
        self.place_divergence = 0.0
        self.class_names: Mapping[int, str] = {}

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Return zeros [H, W]."""
        return np.zeros(frame.depth_m.shape, np.int32)

    def state(self) -> dict[str, NDArray]:
        """Return an empty state."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Accept an earlier `state`, which is empty."""
