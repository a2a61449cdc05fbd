"""Options of mapping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.base.options import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveInt,
    Range,
)
from toolkit.splatting.gaussians.options import SeedingOptions
from toolkit.splatting.losses.options import RgbdLossWeights


@dataclass(frozen=True)
class KeyframePolicy:
    """When a tracked frame becomes a keyframe."""

    interval: PositiveInt = 5
    """Maximum number of frames between keyframes (GauSem-SLAM: d_k)."""
    # 0.9 halves the keyframes of fr1_rpy, but drift on a noisy ring grows from 0.23 to 0.35 cm.
    min_overlap: Fraction = 0.93
    """Minimum overlap of a frame with the last keyframe. Below it, the frame becomes a
    keyframe."""
    revisit: NonNegativeFloat = 0.05
    """Maximum motion from an earlier keyframe of the submap, as translation over median depth plus
    rotation in radians, at which a frame shows a place again and does not become a keyframe. 0: all
    visits of a place add keyframes."""

    def wants(self, frames_since_last: int, overlap: float) -> bool:
        """Whether the newest frame should become a keyframe.

        Args:
            frames_since_last: since the last keyframe.
            overlap: fraction of the last keyframe's points that the newest frame sees.
        """
        return frames_since_last >= self.interval or overlap < self.min_overlap


@dataclass(frozen=True)
class ConsensusOptions:
    """Correction of a keyframe's label segments by the labels of other keyframes."""

    use: bool = True
    """Fit the codes of Gaussians to the labels of all keyframes before the final refinement."""
    # A second round changes fewer than 0.2 % of the pixels and no mIoU by more than 0.01 points.
    rounds: NonNegativeInt = 1
    """Number of rounds of correction and voting; 0 only votes."""


@dataclass(frozen=True)
class MapperOptions:
    """Mapping: seeding, optimisation and refinement of the Gaussians."""

    # Trajectories do not gain from more. With 12, a room and three recordings gained 0.1 to 0.3 dB,
    # in more than twice the time.
    iterations: NonNegativeInt = 3
    """Minimum number of optimisation iterations per keyframe; up to 12 for much new surface."""
    first_iterations: NonNegativeInt = 20
    """Number of optimisation iterations on the first keyframe."""
    final_iterations: NonNegativeInt = 6
    """Number of optimisation iterations per keyframe in the final refinement."""
    # Without them, unseen views of a kitchen lose 0.3 dB, in the same number of steps. Four are not
    # better than two.
    final_views: NonNegativeInt = 2
    """Maximum number of frames after each keyframe that the final refinement compares as well. They
    are stored compressed until then. 0: keyframes only, as in both papers."""
    # Without them, renderings gain 0.1 dB, but walls are four times as thick.
    final_on_surfaces: bool = True
    """Let neighbours leave their surface only together during the final refinement."""
    # Ellipsoids are better on unseen views of seven recordings, with a third to half of the
    # Gaussians (measured at commit bb91ef7bd0).
    final_shape: Literal["ellipsoids", "spheres"] = "ellipsoids"
    """Shape of the Gaussians of the finished map. Ellipsoids are merged from the spheres on which
    the camera was tracked, before the final refinement, and are rendered as 3DGS does."""
    fill_holes: bool = True
    """Seed Gaussians where no keyframe measured depth: from frames between keyframes, and at an
    inferred depth before the final refinement."""
    final_poses: bool = False
    """Optimise keyframe poses during the final refinement (GauSem-SLAM, stage 1)."""
    final_feature: NonNegativeFloat = 0.0
    """Weight of the feature loss in the final refinement (GauSem-SLAM, stage 1: 0.5). The images
    are those of --loops.features.source, the encoder is that of --loops.features.kind, or builtin
    where that one is not differentiable."""
    final_anchors: bool = False
    """Optimise the poses of submaps on the renderings of their joint map after the final refinement
    (GauSem-SLAM, stage 2), instead of registering overlapping submaps before it."""
    # At 0.5, small holes remain: -0.5 dB and 10 % fewer Gaussians (in a room and a ring of rooms).
    min_silhouette: Annotated[float, Range(gt=0, lt=1)] = 0.85
    """Silhouette below which new Gaussians are seeded (Hier-SLAM++: tau_sil)."""
    fuse_depth: bool = True
    """Keep centres at the running mean of the measured depths."""
    centred: bool = True
    """Fit colours at the centres of the Gaussians until the final refinement, for the dense
    tracker."""
    # The first keyframe stays fixed; otherwise the whole map would drift.
    bundle_adjustment: bool = False
    """Optimise keyframe poses together with the map."""
    free_space: bool = True
    """Remove Gaussians that keyframes measured through, and do not seed any there."""
    white_balance: bool = True
    """Estimate gains of the colour channels of each keyframe, relative to the first one."""
    moving_objects: bool = True
    """Leave out regions of a keyframe whose depth and colour contradict earlier keyframes."""
    inferred_depth: Fraction = 0.1
    """Weight of depth inferred from depth priors in the depth loss, relative to other depth."""
    keyframes: KeyframePolicy = KeyframePolicy()
    seeding: SeedingOptions = SeedingOptions()
    loss: RgbdLossWeights = RgbdLossWeights()
    consensus: ConsensusOptions = ConsensusOptions()
