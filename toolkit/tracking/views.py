"""A frame to be located in a map, and the views of the map that it is aligned to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import FrameLevel, ModelLevel
from toolkit.frame import Frame
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.tracking.prepared import PreparedFrame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RenderedView:
    """The map rendered at a pose: image pyramid from fine to coarse."""

    T_map_view: Array
    levels: list[ModelLevel]


@dataclass(frozen=True)
class Task:
    """A frame to be located in a map."""

    prepared: PreparedFrame
    gaussians: GaussianCloud

    @property
    def frame(self) -> Frame:
        """The frame without preprocessing."""
        return self.prepared.frame

    @property
    def levels(self) -> list[FrameLevel]:
        """Image pyramid of the frame, from fine to coarse."""
        return self.prepared.levels

    def distance(self, T_map_first: Array, T_map_second: Array) -> float:
        """Size of the motion between two poses [4, 4]."""
        return self.size(se3.inverse(T_map_first) @ T_map_second)

    def size(self, motion: Array) -> float:
        """Translation of a motion [4, 4] as a fraction of the median depth, plus rotation (rad).

        This is about the displacement of the image in focal lengths.
        """
        metres = np.linalg.norm(motion[:3, 3])
        radians = se3.rotation_angle_rad(motion[:3, :3])
        return float(metres / self.prepared.median_depth_m + radians)
