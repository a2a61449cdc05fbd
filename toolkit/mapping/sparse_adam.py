"""Adam that updates only the visible Gaussians, and supports adding and removing Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import PARAMETERS, GaussianCloud
from toolkit.gaussians.rows import append_rows, select_rows
from toolkit.mapping.options import LearningRates
from toolkit.native import address, kernels_for

BETA1, BETA2 = 0.9, 0.99


class SparseAdam:
    """Adam optimiser with moments and a step count for each Gaussian of a map."""

    def __init__(
        self,
        rates: LearningRates,
        feature_channels: int = 0,
        device: str | torch.device = "cpu",
    ) -> None:
        self.rates = rates
        empty = GaussianCloud.empty(feature_channels, device)
        self._first = {name: torch.zeros_like(getattr(empty, name)) for name in PARAMETERS}
        self._second = {name: torch.zeros_like(getattr(empty, name)) for name in PARAMETERS}
        self.steps = torch.zeros(0, dtype=torch.int32, device=device)

    def extend(self, count: int) -> None:
        """Append zero moments for new Gaussians."""
        self.steps = append_rows(self.steps, self.steps.new_zeros(count))
        for moments in (self._first, self._second):
            for name, moment in moments.items():
                zeros = moment.new_zeros(count, *moment.shape[1:])
                moments[name] = append_rows(moment, zeros)

    def keep(self, indices: Tensor) -> None:
        """Keep the Gaussians `indices` [M], and remove the others.

        Those of a view stay consecutive, which the kernel is fast for.
        """
        self.steps = select_rows(self.steps, indices)
        for moments in (self._first, self._second):
            for name, moment in moments.items():
                moments[name] = select_rows(moment, indices)

    def reset(self, name: str) -> None:
        """Set the moments of a parameter to zero, for instance after its values were replaced."""
        self._first[name].zero_()
        self._second[name].zero_()

    def step(
        self,
        cloud: GaussianCloud,
        gradients: dict[str, Tensor],
        ids: Tensor,
        rate_factor: float = 1.0,
    ) -> None:
        """Update the Gaussians `ids` [V] of a cloud in place from compact gradients [V, ...].

        Parameters without a gradient in the dictionary do not change.

        Args:
            rate_factor: factor of all learning rates.
        """
        module = kernels_for(cloud.means)
        if module is None:
            self._step_torch(cloud, gradients, ids, rate_factor)
            return
        groups = []
        # Centres first: their unit is the radius before this step, as in `_step_torch`.
        for name, gradient in sorted(gradients.items(), key=lambda item: item[0] != "means"):
            parameter = getattr(cloud, name)
            width = parameter[0].numel() if len(parameter) else 1
            if width == 0:
                continue
            tensors = (parameter, self._first[name], self._second[name], gradient)
            unit = address(cloud.log_radii) if name == "means" else 0
            rate = rate_factor * getattr(self.rates, name)
            groups.append((*(address(t) for t in tensors), width, rate, unit))
        settings = (BETA1, BETA2, self.rates.epsilon, self.rates.settle_steps)
        module.adam(address(ids), len(ids), address(self.steps), groups, settings)

    def _step_torch(
        self,
        cloud: GaussianCloud,
        gradients: dict[str, Tensor],
        ids: Tensor,
        rate_factor: float,
    ) -> None:
        self.steps[ids] += 1
        steps = self.steps[ids].to(torch.float32)
        settle = self.rates.settle_steps
        settled = 1.0 / (1.0 + steps / settle) if settle else torch.ones_like(steps)
        radii = cloud.log_radii[ids].exp()
        for name, gradient in gradients.items():
            first, second = self._first[name], self._second[name]
            if name == "means":
                gradient = gradient * radii[:, None]
            wide = (slice(None),) + (None,) * (gradient.ndim - 1)
            m = first[ids] * BETA1 + gradient * (1.0 - BETA1)
            v = second[ids] * BETA2 + gradient**2 * (1.0 - BETA2)
            first[ids], second[ids] = m, v
            rate = rate_factor * getattr(self.rates, name) * settled / (1.0 - BETA1**steps)
            if name == "means":
                rate = rate * radii
            scale = (v / (1.0 - BETA2**steps)[wide]).sqrt() + self.rates.epsilon
            getattr(cloud, name)[ids] -= rate[wide] * m / scale

    def state(self) -> dict[str, NDArray]:
        """Arrays for `restore`."""
        arrays: dict[str, NDArray] = {"steps": self.steps.cpu().numpy()}
        for kind, moments in (("first", self._first), ("second", self._second)):
            arrays.update({f"{kind}_{name}": m.cpu().numpy() for name, m in moments.items()})
        return arrays

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore the moments of an earlier `state`."""
        device = self.steps.device
        self.steps = torch.from_numpy(np.array(arrays["steps"])).to(device)
        for kind, moments in (("first", self._first), ("second", self._second)):
            for name in moments:
                moment = torch.from_numpy(np.array(arrays[f"{kind}_{name}"]))
                moments[name] = moment.to(device)
