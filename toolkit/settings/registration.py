"""Settings of registration."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from toolkit.alignment.options import HealthLimits
from toolkit.settings.base import Settings


class JointAlignmentSettings(Settings):
    """Joint dense Gauss-Newton over pairs of views."""

    levels: int = Field(4, ge=1, le=7, description="pyramid levels")
    iterations: int = Field(12, ge=1, description="most steps a level")
    max_distance: float = Field(0.05, gt=0, description="depth gate, share of the depth")
    exposure: bool = Field(True, description="estimate gain and bias of every pair")
    max_translation_m: float = Field(0.2, gt=0, description="longest step, m")
    max_rotation_rad: float = Field(0.2, gt=0, description="longest step, rad")
    small_translation_m: float = Field(1e-4, gt=0, description="a step that ends, m")
    small_rotation_rad: float = Field(5e-5, gt=0, description="a step that ends, rad")


class MatchingSettings(Settings):
    """Offsets between the observed images of two keyframes."""

    features: int = Field(1500, ge=3, description="most SIFT features an image")
    ratio: float = Field(0.8, gt=0, le=1, description="nearest match to second nearest")
    hypotheses: int = Field(500, ge=1, description="motions tried")
    tolerance_rad: float = Field(0.008, gt=0, description="error of a match's direction, rad")
    tolerance_depth: float = Field(0.05, gt=0, description="error of its depth, a share")
    min_matches: int = Field(12, ge=3, description="fewest that agree")
    max_width: int = Field(400, ge=16, description="images are halved down to it, pixels")
    dense: JointAlignmentSettings = JointAlignmentSettings(levels=3)
    limits: HealthLimits = HealthLimits()
    redundancy: float = Field(5.0, ge=1, description="residuals that count as one")


class PlacementSettings(Settings):
    """Keyframes placed by what earlier ones observed."""

    use: bool = Field(True, description="or leave them where the tracker puts them")
    recent: int = Field(2, ge=1, description="newest keyframes compared")
    older: int = Field(4, ge=0, description="most older ones compared")
    every: int = Field(4, ge=1, description="each n-th keyframe may be one of these")
    min_recent: float = Field(0.2, ge=0, le=1, description="share of the view they must show")
    min_older: float = Field(0.5, ge=0, le=1, description="the same for older ones")
    max_width: int = Field(400, ge=16, description="images are halved down to it, pixels")
    dense: JointAlignmentSettings = JointAlignmentSettings(levels=2)


class MotionAverageSettings(Settings):
    """The robust mean of motions (G-5)."""

    sigma_translation_m: float = Field(0.03, gt=0, description="of a hypothesis, m")
    sigma_rotation_rad: float = Field(0.02, gt=0, description="of a hypothesis, rad")
    agree_within: float = Field(4.0, gt=0, description="in sigmas")
    iterations: int = Field(30, ge=1, description="most steps")


class CoarseSettings(Settings):
    """Coarse registration from alike keyframes (G-5)."""

    pairs: int = Field(10, ge=1, description="most pairs of keyframes (G: k)")
    offsets: Literal["measured", "none"] = Field(
        "measured", description="between a pair's images, or none (G)"
    )
    min_agreeing: int = Field(2, ge=1, description="fewest pairs that agree")
    enough: int = Field(4, ge=1, description="pairs that agree and spare the others")
    matching: MatchingSettings = MatchingSettings()
    average: MotionAverageSettings = MotionAverageSettings()


class FirstOrderFineSettings(Settings):
    """Baseline, the paper's optimiser of the fine stage (G-6)."""

    semantic: float = Field(1.0, ge=0, description="weight of the semantic term")
    feature: float = Field(
        0.5, ge=0, description="weight of the feature term, by the encoder of --loops.features"
    )
    iterations: int = Field(150, ge=1, description="most Adam steps")
    translation_rate: float = Field(0.005, gt=0, description="learning rate, m")
    rotation_rate: float = Field(0.003, gt=0, description="learning rate, rad")
    patience: int = Field(8, ge=1, description="steps without gain that end a round")
    min_gain: float = Field(0.001, ge=0, lt=1, description="gain that counts, a share")
    rounds: int = Field(3, ge=1, description="with ever shorter steps")
    rate_decay: float = Field(0.2, gt=0, le=1, description="of the rates, from round to round")
    min_silhouette: float = Field(0.9, gt=0, lt=1, description="thinner pixels are ignored")


class FineSettings(Settings):
    """Fine registration by rendering (G-6)."""

    optimiser: Literal["dense", "first-order"] = Field(
        "dense", description="Gauss-Newton, or Adam on colour, semantics, features (G-6)"
    )
    views: int = Field(10, ge=1, description="most views of the source (G: k)")
    renders: int = Field(6, ge=1, description="drawings of the target from each view, most")
    rerender_distance: float = Field(0.01, gt=0, description="motion that asks for a drawing")
    min_overlap: float = Field(0.1, ge=0, le=1, description="less is no registration")
    semantic_gate: bool = Field(True, description="leave out pixels whose classes differ")
    redundancy: float = Field(500.0, ge=1, description="residuals that count as one")
    dense: JointAlignmentSettings = JointAlignmentSettings()
    first_order: FirstOrderFineSettings = FirstOrderFineSettings()


class CloudSettings(Settings):
    """Baseline, registration of point clouds by Open3D."""

    search: Literal["ransac", "fast"] = Field("ransac", description="how features are matched")
    icp: Literal["point-to-plane", "coloured"] = Field("point-to-plane", description="afterwards")
    voxel_m: float = Field(0.05, gt=0, description="of the thinned clouds, m")
    min_opacity: float = Field(0.5, ge=0, lt=1, description="thinner Gaussians are left out")
    hypotheses: int = Field(50000, ge=1, description="of RANSAC")
    min_fitness: float = Field(0.1, ge=0, le=1, description="share of points that must fit")
    views: int = Field(5, ge=1, description="from which the result is judged")


class DrawingSettings(Settings):
    """How submaps are drawn to be compared."""

    min_silhouette: float = Field(0.9, gt=0, lt=1, description="thinner pixels are ignored")
    max_width: int = Field(400, ge=16, description="images are halved down to it, pixels")


class RegistrationSettings(Settings):
    """Which registration of submaps, and its values."""

    kind: Literal["sgr", "coarse", "fine", "two-way", "clouds"] = Field(
        "sgr", description="both stages, one alone, or a baseline: coarse and two-way, or Open3D"
    )
    second_opinion: bool = Field(False, description="of Open3D on clouds, which must not object")
    drawing: DrawingSettings = DrawingSettings()
    coarse: CoarseSettings = CoarseSettings()
    fine: FineSettings = FineSettings()
    clouds: CloudSettings = CloudSettings()
