"""Options of the registration of submaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from toolkit.base.options import NonNegativeFloat, PositiveFloat, PositiveInt


@dataclass(frozen=True)
class RegistrationOptions:
    """Registration of submaps (GauSem-SLAM, III.B)."""

    kind: Literal["sgr", "coarse", "fine", "two-way", "clouds"] = "sgr"
    """Registration: coarse and fine (sgr), one stage (coarse, fine), or a baseline: coarse and
    two-way (two-way) or point clouds by Open3D (clouds)."""
    second_opinion: bool = False
    """Reject registrations that point cloud registration by Open3D contradicts."""
    pairs: PositiveInt = 10
    """Maximum number of keyframe pairs of the coarse stage (GauSem-SLAM: k)."""
    offsets: Literal["measured", "none"] = "measured"
    """Relative pose of the keyframes of a pair: measured from their images (measured) or the
    identity as in GauSem-SLAM (none)."""
    enough: PositiveInt = 4
    """Number of agreeing keyframe pairs after which no more are measured."""
    agree_within: PositiveFloat = 4.0
    """Maximum difference of the motion of a keyframe pair from the robust average, in standard
    deviations."""
    optimiser: Literal["dense", "first-order"] = "dense"
    """Optimiser of the fine stage: dense Gauss-Newton (dense) or the paper's Adam
    (first-order)."""
    views: PositiveInt = 10
    """Maximum number of views of the source in the fine stage (GauSem-SLAM: k)."""
    semantic_gate: bool = True
    """Exclude pixels whose classes differ from the fine stage."""
    semantic: NonNegativeFloat = 1.0
    """Weight of the semantic term relative to the colour term, for the first-order optimiser."""
    feature: NonNegativeFloat = 0.5
    """Weight of the feature term relative to the colour term, for the first-order optimiser. Its
    encoder is that of --loops.features, or the built-in one if that has no gradients (vlad)."""
