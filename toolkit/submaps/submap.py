"""A piece of the map: Gaussians and keyframes in one frame of their own (G-III.A)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.mapping.keyframes import Keyframe


@dataclass
class Submap:
    """Everything but `T_world_submap` is in the submap's frame, its first camera's.

    Attributes:
        number: its place in the sequence of submaps, from 0.
        T_world_submap: [4, 4] float64, the anchor's pose; corrections change it alone.
        gaussians: N Gaussians.
        keyframes: their `T_map_camera` is `T_submap_camera`.
        seeded_by: [N] int32, for each Gaussian the frame index of the keyframe it came from.
        descriptors: [K, D] float32 of unit length, one row a keyframe; D may be 0.
    """

    number: int
    T_world_submap: NDArray[np.float64]
    gaussians: GaussianCloud
    keyframes: list[Keyframe]
    seeded_by: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int32))
    descriptors: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    def T_world_camera(self, keyframe: Keyframe) -> NDArray[np.float64]:
        """[4, 4] pose of one of its keyframes in the world."""
        return self.T_world_submap @ keyframe.T_map_camera
