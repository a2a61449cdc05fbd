"""Options of the registration of submaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from toolkit.base.options import NonNegativeFloat, PositiveFloat, PositiveInt


@dataclass(frozen=True)
class RegistrationOptions:
    """Registration of submaps (GauSem-SLAM, III.B)."""

    kind: Literal["sgr", "coarse", "fine"] = "sgr"
    """Registration: coarse and fine (sgr), or one stage (coarse, fine)."""
    views: PositiveInt = 10
    """Maximum number of keyframe pairs of the coarse stage, and of views of the source in the fine
    stage (GauSem-SLAM: k)."""
    offsets: Literal["measured", "none"] = "measured"
    """Relative pose of the keyframes of a pair: measured from their images (measured) or the
    identity as in GauSem-SLAM (none)."""
    agree_within: PositiveFloat = 4.0
    """Maximum difference of the motion of a keyframe pair from the robust average, in standard
    deviations."""
    optimiser: Literal["dense", "first-order"] = "dense"
    """Optimiser of the fine stage: dense Gauss-Newton (dense) or the paper's Adam
    (first-order)."""
    feature: NonNegativeFloat = 0.5
    """Weight of the feature term relative to the colour term, for the first-order optimiser. Its
    encoder is that of --loops.features, or the built-in one if that has no gradients (vlad)."""
