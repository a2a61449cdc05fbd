"""State of the optimiser of a submap's Gaussians: step counts, and moments while it is active."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.rows import append_rows, select_rows

Moments = dict[str, Tensor]


class OptimiserState:
    """Step counts of N Gaussians, and the moments of their parameters since the first step.

    Args:
        steps: [N] int32, number of optimisation steps of each Gaussian.
    """

    def __init__(self, steps: Tensor) -> None:
        self.steps = steps
        self._moments: tuple[Moments, Moments] | None = None

    @property
    def is_active(self) -> bool:
        """Whether steps were taken since the moments were released."""
        return self._moments is not None

    def moments(self, cloud: GaussianCloud) -> tuple[Moments, Moments]:
        """First and second moments by parameter, shaped as those of the cloud.

        They start at zero with the first call, so that a submap that is not optimised has none.
        """
        if self._moments is None:
            first, second = (
                {name: torch.zeros_like(tensor) for name, tensor in cloud.tensors().items()}
                for _ in range(2)
            )
            self._moments = first, second
        return self._moments

    def extend(self, count: int) -> None:
        """Append new Gaussians, without steps and moments."""
        self.steps = append_rows(self.steps, self.steps.new_zeros(count))
        for moments in self._moments or ():
            for name, moment in moments.items():
                zeros = moment.new_zeros(count, *moment.shape[1:])
                moments[name] = append_rows(moment, zeros)

    def keep(self, indices: Tensor) -> None:
        """Keep the Gaussians `indices` [M], and remove the others.

        Those of a view stay consecutive, which the kernel is fast for.
        """
        self.steps = select_rows(self.steps, indices)
        for moments in self._moments or ():
            for name, moment in moments.items():
                moments[name] = select_rows(moment, indices)

    def reset(self, name: str) -> None:
        """Set the moments of a parameter to zero, for instance after its values were replaced."""
        for moments in self._moments or ():
            moments[name].zero_()

    def release(self) -> None:
        """Set all moments to zero and free their memory."""
        self._moments = None

    def to(self, device: str | torch.device) -> OptimiserState:
        """A copy on a device, without moments."""
        return OptimiserState(self.steps.to(device, copy=True))

    def state(self) -> dict[str, NDArray]:
        """Arrays for `from_state`; shared, not copied."""
        arrays: dict[str, NDArray] = {"steps": self.steps.cpu().numpy()}
        for kind, moments in zip(("first", "second"), self._moments or (), strict=False):
            arrays |= {f"{kind}_{name}": m.cpu().numpy() for name, m in moments.items()}
        return arrays

    @classmethod
    def from_state(
        cls, arrays: Mapping[str, NDArray], device: str | torch.device = "cpu"
    ) -> OptimiserState:
        """Restore a `state` on a device."""

        def tensor(name: str) -> Tensor:
            return torch.from_numpy(np.array(arrays[name])).to(device)

        restored = cls(tensor("steps"))
        if "first_means" in arrays:
            names = [name.removeprefix("first_") for name in arrays if name.startswith("first_")]
            first, second = (
                {name: tensor(f"{kind}_{name}") for name in names} for kind in ("first", "second")
            )
            restored._moments = first, second
        return restored
