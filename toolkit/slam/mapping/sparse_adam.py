"""Adam that updates only the visible Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toolkit.base.native import address, kernels_for
from toolkit.slam.submaps.optimiser_state import OptimiserState
from toolkit.splatting.gaussians.cloud import GaussianCloud

BETA1, BETA2 = 0.9, 0.99


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of the Gaussians' parameters.

    Attributes:
        means: of the centres, in radii of the Gaussian.
        log_radii, opacity_logits: of the logarithms of the radii, and of the opacity logits.
        colours: for colours in [0, 1].
        log_scales, rotations, harmonics: of the shapes of ellipsoids.
        features: of the semantic code, in logits.
        epsilon: Adam's. Gradients well below it have little effect, so that Gaussians that fit the
            images do not move.
        settle_steps: number of iterations of a Gaussian after which its learning rates are halved.
            0 keeps them constant.
    """

    means: float = 0.04
    log_radii: float = 0.01
    opacity_logits: float = 0.05
    colours: float = 0.01
    log_scales: float = 0.02
    rotations: float = 0.01
    harmonics: float = 0.002
    features: float = 1.0
    epsilon: float = 0.05
    settle_steps: float = 120.0


SPHERE_RATES = LearningRates()
# Ellipsoids are merged from spheres that fit the images: their colours and classes change little,
# their shapes much. With the feature rate of spheres, labels of a noisy room lose 5 % of mIoU; with
# half of this one, those of office0 lose 0.4 %. With the rates of spheres for centres and
# rotations, depth errors of rooms are 5 % larger and a short recording loses 0.3 dB; with a quarter
# of this one for centres, the depth of the HoloLens walk is twice as wrong.
ELLIPSOID_RATES = LearningRates(
    means=0.02, colours=0.004, rotations=0.005, features=0.2, epsilon=0.0005
)


class SparseAdam:
    """Steps of Adam for the Gaussians in view; their moments belong to the submap.

    Args:
        feature_unit: factor of the learning rate of the features.
    """

    def __init__(
        self,
        spheres: LearningRates = SPHERE_RATES,
        ellipsoids: LearningRates = ELLIPSOID_RATES,
        feature_unit: float = 1.0,
    ) -> None:
        self._rates = [
            replace(rates, features=rates.features * feature_unit)
            for rates in (spheres, ellipsoids)
        ]

    def _rates_of(self, cloud: GaussianCloud) -> LearningRates:
        return self._rates[cloud.ellipsoids is not None]

    def step(
        self,
        state: OptimiserState,
        cloud: GaussianCloud,
        gradients: dict[str, Tensor],
        ids: Tensor,
        rate_factor: float = 1.0,
    ) -> None:
        """Update the Gaussians `ids` [V] of a cloud in place from compact gradients [V, ...].

        Parameters without a gradient in the dictionary do not change.

        Args:
            state: of the cloud's Gaussians; it changes.
            rate_factor: factor of all learning rates.
        """
        module = kernels_for(cloud.means)
        if module is None:
            self._step_torch(state, cloud, gradients, ids, rate_factor)
            return
        rates = self._rates_of(cloud)
        (first, second), parameters, groups = state.moments(cloud), cloud.tensors(), []
        # Centres first: their unit is the radius before this step, as in `_step_torch`.
        for name, gradient in sorted(gradients.items(), key=lambda item: item[0] != "means"):
            parameter = parameters[name]
            width = parameter[0].numel() if len(parameter) else 1
            if width == 0:
                continue
            tensors = (parameter, first[name], second[name], gradient)
            unit = address(cloud.log_radii) if name == "means" else 0
            rate = rate_factor * getattr(rates, name)
            groups.append((*(address(t) for t in tensors), width, rate, unit))
        settings = (BETA1, BETA2, rates.epsilon, rates.settle_steps)
        module.adam(address(ids), len(ids), address(state.steps), groups, settings)

    def _step_torch(
        self,
        state: OptimiserState,
        cloud: GaussianCloud,
        gradients: dict[str, Tensor],
        ids: Tensor,
        rate_factor: float,
    ) -> None:
        rates = self._rates_of(cloud)
        state.steps[ids] += 1
        steps = state.steps[ids].to(torch.float32)
        settle = rates.settle_steps
        settled = 1.0 / (1.0 + steps / settle) if settle else torch.ones_like(steps)
        radii = cloud.log_radii[ids].exp()
        first_moments, second_moments = state.moments(cloud)
        parameters = cloud.tensors()
        for name, gradient in gradients.items():
            first, second = first_moments[name], second_moments[name]
            if name == "means":
                gradient = gradient * radii[:, None]
            wide = (slice(None),) + (None,) * (gradient.ndim - 1)
            m = first[ids] * BETA1 + gradient * (1.0 - BETA1)
            v = second[ids] * BETA2 + gradient**2 * (1.0 - BETA2)
            first[ids], second[ids] = m, v
            rate = rate_factor * getattr(rates, name) * settled / (1.0 - BETA1**steps)
            if name == "means":
                rate = rate * radii
            scale = (v / (1.0 - BETA2**steps)[wide]).sqrt() + rates.epsilon
            parameters[name][ids] -= rate[wide] * m / scale
