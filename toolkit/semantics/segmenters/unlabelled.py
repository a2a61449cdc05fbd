"""No labels at all."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.frame import Frame


class Unlabelled:
    """Every pixel is void: for runs without semantics, so that no caller needs an `if`."""

    def __init__(self) -> None:
        self.place_divergence = 0.0
        self.class_names: Mapping[int, str] = {}

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Zeros [H, W]."""
        return np.zeros(frame.depth_m.shape, np.int32)

    def state(self) -> dict[str, NDArray]:
        """Nothing."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take over an earlier `state`, which is empty."""
