"""A submap: Gaussians and keyframes in their own coordinate frame (G-III.A)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import PARAMETERS, GaussianCloud
from toolkit.io.arrays import arrays_below
from toolkit.keyframe import Keyframe
from toolkit.mapping.gaussian_map import MapContent


def _none() -> Tensor:
    return torch.zeros(0, dtype=torch.int32)


@dataclass
class Submap:
    """Gaussians and keyframes in the submap's frame, which is that of its first camera.

    Attributes:
        number: index in the sequence of submaps, from 0.
        T_world_submap: [4, 4] float64 pose of the anchor; loop closure between submaps changes it.
        gaussians: N Gaussians.
        keyframes: in order; their `T_map_camera` is `T_submap_camera`.
        seeded_by: [N] int32 frame index of the keyframe that seeded each Gaussian, or of the one
            that has measured it since from much nearer.
        descriptors: [K, D] float32 of unit length, one row per keyframe; D may be 0.
        steps: [N] int32 number of optimisation steps of each Gaussian.
    """

    number: int
    T_world_submap: NDArray[np.float64]
    gaussians: GaussianCloud
    keyframes: list[Keyframe]
    seeded_by: Tensor = field(default_factory=_none)
    descriptors: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    steps: Tensor = field(default_factory=_none)

    def T_world_camera(self, keyframe: Keyframe) -> NDArray[np.float64]:
        """Pose [4, 4] of one of the submap's keyframes in the world frame."""
        return self.T_world_submap @ keyframe.T_map_camera

    @property
    def content(self) -> MapContent:
        """The content in the form that a mapper expects; shared, not copied."""
        return MapContent(self.gaussians, self.keyframes, self.seeded_by, self.steps)

    def renumbered(self, number: int, offset: int) -> Submap:
        """The same submap with another number, and with an offset added to all frame indices."""
        return replace(
            self,
            number=number,
            keyframes=[replace(k, index=k.index + offset) for k in self.keyframes],
            seeded_by=self.seeded_by + offset,
        )

    @property
    def size_mb(self) -> float:
        """Size of the arrays in MB."""
        arrays, _ = self.state()
        return sum(array.nbytes for array in arrays.values()) / 1e6

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values for `from_state`; shared, not copied."""
        arrays = {f"gaussians/{name}": getattr(self.gaussians, name).numpy() for name in PARAMETERS}
        arrays |= {
            "T_world_submap": self.T_world_submap,
            "seeded_by": self.seeded_by.numpy(),
            "descriptors": self.descriptors,
            "steps": self.steps.numpy(),
        }
        for number, keyframe in enumerate(self.keyframes):
            arrays |= {f"keyframes/{number}/{k}": a for k, a in keyframe.arrays().items()}
        return arrays, {
            "number": self.number,
            "keyframes": [k.values() for k in self.keyframes],
            "centred_colours": self.gaussians.centred_colours,
        }

    @classmethod
    def from_state(cls, arrays: dict[str, NDArray], values: dict[str, Any]) -> Submap:
        """Restore a submap from its `state`."""

        def tensor(name: str) -> Tensor:
            return torch.from_numpy(np.array(arrays[name]))

        keyframes = [
            Keyframe.from_state(arrays_below(arrays, f"keyframes/{number}/"), value)
            for number, value in enumerate(values["keyframes"])
        ]
        return cls(
            number=int(values["number"]),
            T_world_submap=np.array(arrays["T_world_submap"]),
            gaussians=GaussianCloud(
                **{n: tensor(f"gaussians/{n}") for n in PARAMETERS},
                # Files of older versions contain refined submaps without this key.
                centred_colours=bool(values.get("centred_colours", False)),
            ),
            keyframes=keyframes,
            seeded_by=tensor("seeded_by"),
            descriptors=np.array(arrays["descriptors"]),
            steps=tensor("steps"),
        )
