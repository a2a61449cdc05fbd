"""What a map is made of, between two optimisers."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.keyframe import Keyframe


@dataclass(frozen=True)
class MapContent:
    """A map without the optimiser's moments.

    Attributes:
        gaussians: N Gaussians. keyframes: in order.
        seeded_by: [N] int32, the frame index of the keyframe each Gaussian came from, or of
            one that has measured it from much nearer since.
        steps: [N] int32, optimisation steps each Gaussian has had.
    """

    gaussians: GaussianCloud
    keyframes: list[Keyframe]
    seeded_by: Tensor
    steps: Tensor
