"""What gives a frame its labels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.frame import Frame


class Segmenter(Protocol):
    """Labels every pixel of a frame, in a vocabulary of its own.

    Attributes:
        place_divergence: KL divergence between the class histograms of two views, in nats,
            above which they are of different places. G has 0.4, for a rich set of classes.
    """

    place_divergence: float

    @property
    def class_names(self) -> Mapping[int, str]:
        """Its classes by id; ids count from 1, and 0 is void."""
        ...

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Class ids [H, W], 0 where it cannot tell.

        Args:
            T_map_camera: the frame's pose [4, 4], measured or predicted, where there is one.

        Raises:
            DatasetError: the frame has no labels where it should, or they are wrong.
        """
        ...

    def state(self) -> dict[str, NDArray]:
        """Arrays that `restore` takes; empty where nothing is remembered."""
        ...

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        ...
