"""A segmenter without labels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.frame import Frame


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
