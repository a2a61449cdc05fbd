"""A submap: Gaussians, keyframes and the state of their optimiser, in their own frame (G-III.A)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.keyframe import Keyframe
from toolkit.io.arrays import arrays_below
from toolkit.slam.submaps.intermediate_views import IntermediateView
from toolkit.slam.submaps.optimiser_state import OptimiserState
from toolkit.splatting.gaussians.cloud import PARAMETERS, GaussianCloud, LowPass
from toolkit.splatting.gaussians.ellipsoids import SHAPES
from toolkit.splatting.gaussians.rows import append_rows, select_rows


def _none() -> Tensor:
    return torch.zeros(0, dtype=torch.int32)


@dataclass
class Submap:
    """Gaussians and keyframes in the submap's frame, which is that of its first camera.

    Attributes:
        number: index in the sequence of submaps, from 0.
        T_world_submap: [4, 4] float64 pose of the anchor; loop closure between submaps changes it.
        gaussians: N Gaussians, on the device that optimises them.
        keyframes: in order; their `T_map_camera` is `T_submap_camera`. Their images are on the CPU.
        seeded_by: [N] int32 frame index of the keyframe that seeded each Gaussian, or of the one
            that has measured its centre since from much nearer.
        descriptors: [K, D] float32 of unit length, one row per keyframe; D may be 0.
        optimiser: state of the Gaussians' optimiser; by default, no steps were taken.
        views: of frames between the keyframes, until the final refinement.
    """

    number: int
    T_world_submap: NDArray[np.float64]
    gaussians: GaussianCloud
    keyframes: list[Keyframe]
    seeded_by: Tensor = field(default_factory=_none)
    descriptors: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    optimiser: OptimiserState = field(default_factory=lambda: OptimiserState(_none()))
    views: list[IntermediateView] = field(default_factory=list)

    def __post_init__(self) -> None:
        if len(self.optimiser.steps) == 0:
            steps = torch.zeros(len(self.gaussians), dtype=torch.int32, device=self.device)
            self.optimiser = OptimiserState(steps)

    @classmethod
    def empty(
        cls, number: int, channels: int, device: torch.device, centred_colours: bool
    ) -> Submap:
        """A submap without Gaussians and keyframes, at the world frame.

        Args:
            channels: number of semantic channels S of its Gaussians.
        """
        cloud = replace(GaussianCloud.empty(channels, device), centred_colours=centred_colours)
        seeded_by = torch.zeros(0, dtype=torch.int32, device=device)
        return cls(number, np.eye(4), cloud, [], seeded_by)

    @property
    def device(self) -> torch.device:
        """Device of the Gaussians."""
        return self.gaussians.means.device

    def to(self, device: str | torch.device) -> Submap:
        """The submap with its Gaussians on a device, without moments; itself if they are there."""
        if self.device.type == torch.device(device).type:
            return self
        return replace(
            self,
            gaussians=self.gaussians.to(device),
            seeded_by=self.seeded_by.to(device),
            optimiser=self.optimiser.to(device),
        )

    def append(self, seeds: GaussianCloud, keyframe: Keyframe) -> None:
        """Add Gaussians that a keyframe seeded."""
        seeds, cloud = seeds.to(self.device), self.gaussians
        if cloud.ellipsoids is not None:
            shapes = seeds.as_ellipsoids().with_degree(cloud.ellipsoids.degree)
            seeds = replace(seeds, ellipsoids=shapes)
        added = seeds.tensors()
        self.gaussians = cloud.with_tensors(
            {name: append_rows(tensor, added[name]) for name, tensor in cloud.tensors().items()}
        )
        self.optimiser.extend(len(seeds))
        seeded_by = self.seeded_by.new_full((len(seeds),), keyframe.index)
        self.seeded_by = append_rows(self.seeded_by, seeded_by)

    def remove(self, mask: Tensor) -> None:
        """Remove the Gaussians in a mask [N]."""
        kept = (~mask).nonzero().squeeze(1)
        self.gaussians = self.gaussians.mapped(lambda tensor: select_rows(tensor, kept))
        self.optimiser.keep(kept)
        self.seeded_by = select_rows(self.seeded_by, kept)

    def move(self, means: Tensor) -> None:
        """Replace the centres [N, 3] of the Gaussians."""
        self.gaussians = replace(self.gaussians, means=means)

    def T_world_camera(self, keyframe: Keyframe) -> NDArray[np.float64]:
        """Pose [4, 4] of one of the submap's keyframes in the world frame."""
        return self.T_world_submap @ keyframe.T_map_camera

    def keyframes_from(self, index: int) -> list[Keyframe]:
        """The keyframe of a frame index and the one after it, as far as they exist."""
        for position in reversed(range(len(self.keyframes))):
            if self.keyframes[position].index == index:
                return self.keyframes[position : position + 2]
        return []

    def renumbered(self, number: int, offset: int) -> Submap:
        """The same submap with another number, and with an offset added to all frame indices."""
        return replace(
            self,
            number=number,
            keyframes=[replace(k, index=k.index + offset) for k in self.keyframes],
            seeded_by=self.seeded_by + offset,
            views=[
                replace(v, index=v.index + offset, keyframe=v.keyframe + offset) for v in self.views
            ],
        )

    @property
    def size_mb(self) -> float:
        """Size of the arrays in MB."""
        arrays, _ = self.state()
        return sum(array.nbytes for array in arrays.values()) / 1e6

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values for `from_state`; shared, not copied."""
        arrays = {
            f"gaussians/{name}": tensor.cpu().numpy()
            for name, tensor in self.gaussians.tensors().items()
        }
        arrays |= {f"optimiser/{name}": array for name, array in self.optimiser.state().items()}
        arrays |= {
            "T_world_submap": self.T_world_submap,
            "seeded_by": self.seeded_by.cpu().numpy(),
            "descriptors": self.descriptors,
        }
        for number, keyframe in enumerate(self.keyframes):
            arrays |= {f"keyframes/{number}/{k}": a for k, a in keyframe.arrays().items()}
        for number, view in enumerate(self.views):
            arrays |= {f"views/{number}/{k}": a for k, a in view.arrays().items()}
        return arrays, {
            "number": self.number,
            "keyframes": [k.values() for k in self.keyframes],
            "views": [v.values() for v in self.views],
            "centred_colours": self.gaussians.centred_colours,
            "low_pass": asdict(self.gaussians.low_pass),
        }

    @classmethod
    def from_state(
        cls,
        arrays: Mapping[str, NDArray],
        values: Mapping[str, Any],
        device: str | torch.device = "cpu",
    ) -> Submap:
        """Restore a submap from its `state`, with the Gaussians on a device."""

        def tensor(name: str) -> Tensor:
            return torch.from_numpy(np.array(arrays[name])).to(device)

        names = [n for n in (*PARAMETERS, *SHAPES) if f"gaussians/{n}" in arrays]
        cloud = replace(
            GaussianCloud.empty(),
            centred_colours=bool(values["centred_colours"]),
            low_pass=LowPass(**values.get("low_pass", {})),
        ).with_tensors({n: tensor(f"gaussians/{n}") for n in names})
        keyframes = [
            Keyframe.from_state(arrays_below(arrays, f"keyframes/{number}/"), value)
            for number, value in enumerate(values["keyframes"])
        ]
        views = [
            IntermediateView.from_state(arrays_below(arrays, f"views/{number}/"), value)
            for number, value in enumerate(values.get("views", ()))
        ]
        # Run folders of format 1 have the steps alone.
        steps = arrays_below(arrays, "optimiser/") or {"steps": arrays["steps"]}
        return cls(
            number=int(values["number"]),
            T_world_submap=np.array(arrays["T_world_submap"]),
            gaussians=cloud,
            keyframes=keyframes,
            seeded_by=tensor("seeded_by"),
            descriptors=np.array(arrays["descriptors"]),
            optimiser=OptimiserState.from_state(steps, device),
            views=views,
        )
