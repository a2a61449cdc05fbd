"""Options of mapping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from toolkit.gaussians.options import SeedingOptions
from toolkit.losses.options import RgbdLossWeights
from toolkit.options import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
)


@dataclass(frozen=True)
class KeyframePolicy:
    """When a tracked frame becomes a keyframe."""

    interval: PositiveInt = 5
    """Maximum number of frames between keyframes (GauSem-SLAM: d_k)."""
    # 0.9 halves the keyframes of fr1_rpy, but drift on a noisy ring grows from 0.23 to 0.35 cm.
    min_overlap: Fraction = 0.93
    """Minimum overlap of a frame with the last keyframe. Below it, the frame becomes a
    keyframe."""

    def wants(self, frames_since_last: int, overlap: float) -> bool:
        """Whether the newest frame should become a keyframe.

        Args:
            frames_since_last: since the last keyframe.
            overlap: fraction of the last keyframe's points that the newest frame sees.
        """
        return frames_since_last >= self.interval or overlap < self.min_overlap


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of the Gaussians' parameters."""

    means: NonNegativeFloat = 0.04
    """Learning rate of the centres, in radii of the Gaussian."""
    log_radii: NonNegativeFloat = 0.01
    """Learning rate of the logarithms of the radii."""
    opacity_logits: NonNegativeFloat = 0.05
    """Learning rate of the opacity logits."""
    colours: NonNegativeFloat = 0.01
    """Learning rate of the colours, for colours in [0, 1]."""
    features: NonNegativeFloat = 1.0
    """Learning rate of the semantic code, in logits."""
    epsilon: PositiveFloat = 0.05
    """Adam's epsilon. Gradients well below it have little effect, so that Gaussians that fit the
    images do not move."""
    settle_steps: NonNegativeFloat = 120.0
    """Number of iterations of a Gaussian after which its learning rates are halved. 0 keeps them
    constant."""


@dataclass(frozen=True)
class ConsensusOptions:
    """Correction of a keyframe's label segments by the labels of other keyframes."""

    use: bool = True
    """Fit the codes of Gaussians to the labels of all keyframes before the final refinement."""
    # A second round changes fewer than 0.2 % of the pixels and no mIoU by more than 0.01 points.
    rounds: NonNegativeInt = 1
    """Number of rounds of correction and voting; 0 only votes."""
    min_views: NonNegativeFloat = 1.5
    """Minimum number of views of a pixel's Gaussians for the pixel to count as evidence."""
    min_share: Fraction = 0.1
    """Minimum fraction of a segment's pixels that are evidence."""
    margin: Fraction = 0.1
    """Minimum probability margin of the map's class over the segment's."""


@dataclass(frozen=True)
class FreeSpaceOptions:
    """Removal of Gaussians from space that keyframes measured as empty."""

    use: bool = True
    """Remove Gaussians that keyframes measured through, and do not seed any there."""
    min_through: PositiveFloat = 1.0
    """Minimum number of keyframes that measured through a Gaussian, each weighted by its
    confidence."""
    min_ratio: NonNegativeFloat = 0.33
    """Minimum ratio of the keyframes that measured through a Gaussian to those that measured a
    surface at its place."""
    views: PositiveInt = 8
    """Maximum number of keyframes compared during mapping, spread over those of the submap."""


@dataclass(frozen=True)
class WhiteBalanceOptions:
    """White balance of keyframes, relative to the first one."""

    use: bool = True
    """Estimate gains of the colour channels of each keyframe."""
    # Where it is constant, the estimates change by 0.1 % in a room with sensor noise, and by 0.5 %
    # in a ring of rooms.
    min_change: NonNegativeFloat = 0.01
    """Minimum change of a channel's gain that is applied, as a fraction."""
    recent: PositiveInt = 3
    """Maximum number of the newest overlapping keyframes that a keyframe is compared with."""
    older: NonNegativeInt = 4
    """Maximum number of other overlapping keyframes that a keyframe is compared with."""


@dataclass(frozen=True)
class MovingObjectOptions:
    """Moving objects in front of a map, which are left out of it."""

    use: bool = True
    """Leave out regions of a keyframe whose depth and colour contradict earlier keyframes."""
    min_area: Fraction = 0.003
    """Minimum fraction of the image that a region covers."""
    max_area: Fraction = 0.4
    """Maximum fraction of the mapped pixels in front of the map. Beyond it, the pose is in doubt
    and nothing is left out."""
    min_through: PositiveFloat = 2.0
    """Minimum number of earlier keyframes that measured through a region, each weighted by its
    confidence."""
    max_still_s: PositiveFloat = 3.0
    """Time in seconds after which an object that has stayed at its place is mapped."""


@dataclass(frozen=True)
class DepthAdjustmentOptions:
    """Scale and shift of corrected depth priors, optimised with the map (Hier-SLAM++, equation 17).

    Depth of sensors and of neighbouring keyframes is not adjusted."""

    use: bool = True
    """Optimise scale and shift of each keyframe whose depth is a corrected prior."""
    shift: bool = True
    """Optimise the shift as well."""
    regularisation: NonNegativeFloat = 0.1
    """Weight of the absolute deviation of scale and shift (in units of the depth) from their
    initial values, relative to the depth loss (Hier-SLAM++: L_reg)."""
    rate: PositiveFloat = 1e-3
    """Learning rate of the scale, and of the shift relative to the median depth."""


@dataclass(frozen=True)
class MapperOptions:
    """Mapping: seeding, optimisation and refinement of the Gaussians."""

    # Trajectories do not gain from more. With 12, a room and three recordings gained 0.1 to 0.3 dB,
    # in more than twice the time.
    iterations: NonNegativeInt = 3
    """Minimum number of optimisation iterations per keyframe."""
    max_iterations: NonNegativeInt = 12
    """Maximum number of optimisation iterations per keyframe. More than the minimum are taken
    while a keyframe that shows much new surface is not explained yet."""
    first_iterations: NonNegativeInt = 20
    """Number of optimisation iterations on the first keyframe."""
    final_iterations: NonNegativeInt = 6
    """Number of optimisation iterations per keyframe in the final refinement."""
    # Unconstrained, renderings gain 0.1 to 0.4 dB, but walls become a third thicker than unrefined.
    final_on_surfaces: bool = True
    """Constrain centres to their surfaces during the final refinement."""
    fill_holes: bool = True
    """Seed Gaussians where no keyframe measured depth: from frames between keyframes, and at an
    inferred depth before the final refinement."""
    final_poses: bool = False
    """Optimise keyframe poses during the final refinement (GauSem-SLAM, stage 1)."""
    final_feature: NonNegativeFloat = 0.0
    """Weight of the feature loss in the final refinement (GauSem-SLAM: 0.5)."""
    window: PositiveInt = 8
    """Maximum number of keyframes optimised together."""
    newest_share: Annotated[float, Range(gt=0, le=1)] = 0.4
    """Fraction of the iterations spent on the newest keyframe."""
    min_overlap: Fraction = 0.15
    """Minimum overlap of a keyframe with the newest one to be optimised together with it."""
    # At 0.5, small holes remain: -0.5 dB and 10 % fewer Gaussians (in a room and a ring of rooms).
    min_silhouette: Annotated[float, Range(gt=0, lt=1)] = 0.85
    """Silhouette below which new Gaussians are seeded (Hier-SLAM++: tau_sil)."""
    depth_floor: NonNegativeFloat = 0.03
    """Minimum depth error that seeds new Gaussians in front of a surface, as a fraction of
    depth."""
    depth_factor: NonNegativeFloat = 20.0
    """Minimum depth error that seeds new Gaussians in front of a surface, as a multiple of the
    median depth error."""
    fuse_depth: bool = True
    """Keep centres at the running mean of the measured depths."""
    centred: bool = True
    """Fit colours at the centres of the Gaussians until the final refinement, for the dense
    tracker."""
    # The first keyframe stays fixed; otherwise the whole map would drift.
    bundle_adjustment: bool = False
    """Optimise keyframe poses together with the map."""
    pose_translation_m: PositiveFloat = 1e-4
    """Learning rate of keyframe translations in bundle adjustment, in metres."""
    pose_rotation_rad: PositiveFloat = 5e-5
    """Learning rate of keyframe rotations in bundle adjustment, in radians."""
    min_opacity: NonNegativeFloat = 0.005
    """Opacity below which Gaussians are pruned."""
    max_radius_m: PositiveFloat = 0.5
    """Radius above which Gaussians are pruned, in metres."""
    inferred_depth: Fraction = 0.1
    """Weight of depth inferred from depth priors in the depth loss, relative to other depth."""
    keyframes: KeyframePolicy = KeyframePolicy()
    seeding: SeedingOptions = SeedingOptions()
    rates: LearningRates = LearningRates()
    loss: RgbdLossWeights = RgbdLossWeights()
    consensus: ConsensusOptions = ConsensusOptions()
    depth_adjustment: DepthAdjustmentOptions = DepthAdjustmentOptions()
    free_space: FreeSpaceOptions = FreeSpaceOptions()
    white_balance: WhiteBalanceOptions = WhiteBalanceOptions()
    moving_objects: MovingObjectOptions = MovingObjectOptions()
