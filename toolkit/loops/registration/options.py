"""Options of the registration of submaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.alignment.options import JointOptions, MatchingOptions
from toolkit.options import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt, Range


@dataclass(frozen=True)
class AverageOptions:
    """Robust average of relative poses (GauSem-SLAM, equation 5)."""

    sigma_translation_m: PositiveFloat = 0.03
    """Standard deviation of a hypothesis's translation, in metres."""
    sigma_rotation_rad: PositiveFloat = 0.02
    """Standard deviation of a hypothesis's rotation, in radians."""
    agree_within: PositiveFloat = 4.0
    """Maximum residual of an inlier hypothesis, in standard deviations."""
    iterations: PositiveInt = 30
    """Maximum number of Gauss-Newton iterations."""


@dataclass(frozen=True)
class CoarseOptions:
    """Coarse registration from pairs of similar keyframes (GauSem-SLAM, equation 5)."""

    pairs: PositiveInt = 10
    """Maximum number of keyframe pairs (GauSem-SLAM: k)."""
    offsets: Literal["measured", "none"] = "measured"
    """Relative pose of the keyframes of a pair: measured from their images (measured) or the
    identity as in GauSem-SLAM (none)."""
    min_agreeing: PositiveInt = 2
    """Minimum number of keyframe pairs that agree."""
    enough: PositiveInt = 4
    """Number of agreeing keyframe pairs after which no more are measured."""
    # Where submaps overlap little, the most similar keyframes often show different places.
    pooled_pairs: PositiveInt = 40
    """Maximum number of keyframe pairs whose feature matches are pooled if no pair determines its
    offset alone."""
    matching: MatchingOptions = MatchingOptions()
    average: AverageOptions = AverageOptions()


@dataclass(frozen=True)
class FirstOrderFineOptions:
    """Baseline of the fine stage: the paper's Adam on the relative pose (GauSem-SLAM, eq. 6)."""

    semantic: NonNegativeFloat = 1.0
    """Weight of the semantic term relative to the colour term."""
    feature: NonNegativeFloat = 0.5
    """Weight of the feature term relative to the colour term. Its encoder is that of
    --loops.features, or the built-in one if that has no gradients (vlad)."""
    iterations: PositiveInt = 150
    """Maximum number of Adam iterations."""
    translation_rate: PositiveFloat = 0.005
    """Learning rate of the translation, in metres."""
    rotation_rate: PositiveFloat = 0.003
    """Learning rate of the rotation, in radians."""
    patience: PositiveInt = 8
    """Number of iterations without a gain that end a round."""
    min_gain: Annotated[float, Range(ge=0, lt=1)] = 0.001
    """Minimum relative decrease of the loss that counts as a gain."""
    rounds: PositiveInt = 3
    """Number of rounds. Each one starts at the best pose so far with lower learning rates."""
    rate_decay: Annotated[float, Range(gt=0, le=1)] = 0.2
    """Factor applied to the learning rates after each round."""
    min_silhouette: Annotated[float, Range(gt=0, lt=1)] = 0.9
    """Minimum silhouette in both maps of the pixels compared."""


@dataclass(frozen=True)
class FineOptions:
    """Fine registration by rendering (GauSem-SLAM, equation 6)."""

    optimiser: Literal["dense", "first-order"] = "dense"
    """Optimiser: dense Gauss-Newton (dense) or the paper's baseline (first-order)."""
    views: PositiveInt = 10
    """Maximum number of views of the source (GauSem-SLAM: k)."""
    renders: PositiveInt = 6
    """Maximum number of renderings of the target per view, for the dense optimiser."""
    rerender_distance: PositiveFloat = 0.01
    """Pose change that triggers a new rendering: translation as a fraction of the median depth,
    or rotation in radians."""
    min_overlap: Fraction = 0.1
    """Minimum overlap of a converged registration."""
    semantic_gate: bool = True
    """Exclude pixels whose classes differ."""
    # A depth camera's errors vary slowly over the image: on RedKitchen, depth is up to 1.5 % too
    # large on one side and too small on the other. Where two views share a third of an image, depth
    # alone moves the result by 6 to 9 cm, and colour alone by 1 to 2 cm.
    dense: JointOptions = JointOptions(geometric_weight=0.05)
    first_order: FirstOrderFineOptions = FirstOrderFineOptions()


@dataclass(frozen=True)
class CloudOptions:
    """Baseline: registration of point clouds by Open3D."""

    search: Literal["ransac", "fast"] = "ransac"
    """Global registration of FPFH features: RANSAC (ransac) or fast global registration (fast)."""
    icp: Literal["point-to-plane", "coloured"] = "point-to-plane"
    """ICP that refines the result of global registration."""
    voxel_m: PositiveFloat = 0.05
    """Voxel size for downsampling before feature matching, in metres; ICP uses half of it."""
    min_opacity: Annotated[float, Range(ge=0, lt=1)] = 0.5
    """Minimum opacity of the Gaussians included in a point cloud."""
    hypotheses: PositiveInt = 50000
    """Maximum number of RANSAC iterations."""
    min_fitness: Fraction = 0.1
    """Minimum fraction of the source's points that lie on the target's surface."""
    views: PositiveInt = 5
    """Number of views of the source in which the result is checked."""


@dataclass(frozen=True)
class DrawingOptions:
    """Rendering of submaps for registration."""

    min_silhouette: Annotated[float, Range(gt=0, lt=1)] = 0.9
    """Minimum silhouette of the rendered pixels used for registration."""
    max_width: Annotated[int, Range(ge=16)] = 400
    """Maximum image width, in pixels. Wider images are halved."""


@dataclass(frozen=True)
class RegistrationOptions:
    """Registration of submaps."""

    kind: Literal["sgr", "coarse", "fine", "two-way", "clouds"] = "sgr"
    """Registration: coarse and fine (sgr), one stage (coarse, fine), or a baseline: coarse and
    two-way (two-way) or point clouds by Open3D (clouds)."""
    second_opinion: bool = False
    """Reject registrations that point cloud registration by Open3D contradicts."""
    drawing: DrawingOptions = DrawingOptions()
    coarse: CoarseOptions = CoarseOptions()
    fine: FineOptions = FineOptions()
    clouds: CloudOptions = CloudOptions()
