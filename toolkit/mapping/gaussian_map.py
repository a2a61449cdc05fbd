"""A map under optimisation: Gaussians, keyframes and the state of the optimiser."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import PARAMETERS, GaussianCloud
from toolkit.gaussians.rows import append_rows, select_rows
from toolkit.io.arrays import arrays_below
from toolkit.keyframe import Keyframe
from toolkit.mapping.options import LearningRates
from toolkit.mapping.sparse_adam import SparseAdam


@dataclass(frozen=True)
class MapContent:
    """Content of a map without the moments of its optimiser, on the CPU.

    Attributes:
        gaussians: N Gaussians.
        keyframes: in order.
        seeded_by: [N] int32 frame index of the keyframe that seeded each Gaussian, or of the one
            that has measured its centre since from much nearer.
        steps: [N] int32, optimisation steps of each Gaussian.
    """

    gaussians: GaussianCloud
    keyframes: list[Keyframe]
    seeded_by: Tensor
    steps: Tensor


class GaussianMap:
    """Gaussians, their keyframes of origin and the state of their optimiser, kept consistent.

    Args:
        rates: learning rates of the optimiser.
        feature_channels: number of feature channels S of the Gaussians.
        device: device that stores the Gaussians.
        centred_colours: of new Gaussians, as in `GaussianCloud`.

    Attributes:
        gaussians: N Gaussians.
        keyframes: in order; their images are on the CPU.
        optimiser: moments and step counts of the N Gaussians.
        seeded_by: [N] int32, as in `MapContent`.
    """

    def __init__(
        self,
        rates: LearningRates,
        feature_channels: int,
        device: torch.device,
        centred_colours: bool,
    ) -> None:
        self.device = device
        empty = GaussianCloud.empty(feature_channels, device)
        self.gaussians = replace(empty, centred_colours=centred_colours)
        self.keyframes: list[Keyframe] = []
        self.optimiser = SparseAdam(rates, feature_channels, device)
        self.seeded_by = torch.zeros(0, dtype=torch.int32, device=device)

    @property
    def content(self) -> MapContent:
        """The content: shared if the map is on the CPU, otherwise a copy."""
        seeded_by, steps = self.seeded_by.cpu(), self.optimiser.steps.cpu()
        return MapContent(self.gaussians.to("cpu"), self.keyframes, seeded_by, steps)

    def replace_content(self, content: MapContent) -> None:
        """Replace the content; the moments of the optimiser are reset."""
        self.gaussians, self.keyframes = content.gaussians.to(self.device), content.keyframes
        self.seeded_by = content.seeded_by.to(self.device)
        channels = self.gaussians.features.shape[1]
        self.optimiser = SparseAdam(self.optimiser.rates, channels, self.device)
        self.optimiser.extend(len(self.gaussians))
        self.optimiser.steps = content.steps.to(self.device, copy=True)

    def append(self, seeds: GaussianCloud, keyframe: Keyframe) -> None:
        """Add Gaussians that a keyframe seeded."""
        seeds, cloud = seeds.to(self.device), self.gaussians
        self.gaussians = GaussianCloud(
            *(append_rows(getattr(cloud, name), getattr(seeds, name)) for name in PARAMETERS),
            centred_colours=cloud.centred_colours,
        )
        self.optimiser.extend(len(seeds))
        seeded_by = self.seeded_by.new_full((len(seeds),), keyframe.index)
        self.seeded_by = append_rows(self.seeded_by, seeded_by)

    def remove(self, mask: Tensor) -> None:
        """Remove the Gaussians in a mask [N]."""
        kept, cloud = (~mask).nonzero().squeeze(1), self.gaussians
        self.gaussians = GaussianCloud(
            *(select_rows(getattr(cloud, name), kept) for name in PARAMETERS),
            centred_colours=cloud.centred_colours,
        )
        self.optimiser.keep(kept)
        self.seeded_by = select_rows(self.seeded_by, kept)

    def move(self, means: Tensor) -> None:
        """Replace the centres [N, 3]."""
        self.gaussians = replace(self.gaussians, means=means)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays = {
            f"gaussians/{name}": getattr(self.gaussians, name).cpu().numpy() for name in PARAMETERS
        }
        arrays |= {f"optimiser/{name}": a for name, a in self.optimiser.state().items()}
        arrays["seeded_by"] = self.seeded_by.cpu().numpy()
        # Copies: the next optimisation step changes the map in place.
        arrays = {name: array.copy() for name, array in arrays.items()}
        for number, keyframe in enumerate(self.keyframes):
            arrays |= {f"keyframes/{number}/{k}": a for k, a in keyframe.arrays().items()}
        return arrays, {
            "keyframes": [keyframe.values() for keyframe in self.keyframes],
            "centred_colours": self.gaussians.centred_colours,
        }

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        tensors = {n: torch.from_numpy(np.array(arrays[f"gaussians/{n}"])) for n in PARAMETERS}
        centred = bool(values["centred_colours"])
        self.gaussians = GaussianCloud(**tensors, centred_colours=centred).to(self.device)
        self.optimiser.restore(arrays_below(arrays, "optimiser/"))
        self.seeded_by = torch.from_numpy(np.array(arrays["seeded_by"])).to(self.device)
        self.keyframes = [
            Keyframe.from_state(arrays_below(arrays, f"keyframes/{number}/"), keyframe)
            for number, keyframe in enumerate(values["keyframes"])
        ]
