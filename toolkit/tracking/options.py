"""Options of tracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.alignment.options import HealthLimits, JointOptions
from toolkit.options import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
)


@dataclass(frozen=True)
class DenseOptions:
    """Options of the dense tracker: Gauss-Newton alignment to the rendered map."""

    levels: Annotated[int, Range(ge=1, le=7)] = 4
    """Number of image pyramid levels. The coarsest image should keep 30 pixels per side."""
    iterations: PositiveInt = 12
    """Maximum number of Gauss-Newton iterations per pyramid level."""
    renders: PositiveInt = 3
    """Maximum number of renderings of the map per frame."""
    # At 0.05, recordings take up to a fifth less time online and are as accurate, but images of a
    # noisy ring of 160x120 pixels lose 2 dB before the refinement.
    rerender_distance: PositiveFloat = 0.02
    """Pose change that triggers a new rendering: translation as a fraction of the median depth,
    or rotation in radians."""
    min_silhouette: Annotated[float, Range(gt=0, lt=1)] = 0.9
    """Minimum silhouette of the rendered pixels used for tracking."""
    max_distance: PositiveFloat = 0.05
    """Maximum depth difference of corresponding pixels at the finest pyramid level, as a fraction
    of depth. It doubles with every coarser level."""
    exposure: bool = True
    """Estimate the exposure (gain and bias) of each frame."""
    photometric_weight: PositiveFloat = 1.0
    """Weight of the photometric term relative to the geometric term."""
    start: Literal["velocity", "auto", "both"] = "auto"
    """Initial pose of a frame. velocity: constant velocity, or the previous pose; auto: also
    Open3D's odometry if the frame then fits badly; both: also Open3D's odometry for every frame.
    The better fit is kept."""


@dataclass(frozen=True)
class FirstOrderOptions:
    """Options of the papers' tracker: Adam on the camera pose."""

    preset: Literal["hier-slam", "gausem"] = "hier-slam"
    """Loss weights of Hier-SLAM (hier-slam) or GauSem (gausem)."""
    iterations: PositiveInt = 40
    """Number of Adam iterations per frame."""
    translation_rate: PositiveFloat = 0.002
    """Learning rate of the translation, in metres."""
    rotation_rate: PositiveFloat = 0.001
    """Learning rate of the rotation, in radians."""
    semantic: NonNegativeFloat | None = None
    """Weight of the semantic term, which needs labels; 0 disables it. By default, the preset's
    weight (hier-slam 0, gausem 0.5)."""


@dataclass(frozen=True)
class PlacementOptions:
    """Refinement of keyframe poses against earlier keyframes."""

    use: bool = True
    """Refine keyframe poses against earlier keyframes."""
    recent: PositiveInt = 2
    """Number of newest keyframes that a new keyframe is aligned to."""
    older: NonNegativeInt = 4
    """Maximum number of older keyframes that a new keyframe is aligned to."""
    # The set of eligible keyframes changes slowly, which reduces drift.
    every: PositiveInt = 4
    """Keyframe interval of the older keyframes: every n-th one is eligible."""
    min_recent: Fraction = 0.2
    """Minimum overlap of the new keyframe with a recent keyframe."""
    min_older: Fraction = 0.5
    """Minimum overlap of the new keyframe with an older keyframe."""
    # Width 160 instead of 320 takes two fifths of the time. It costs 0.1 mm on a ring of rooms and
    # a quarter of a decibel in mapped views of fr1_rpy.
    max_width: Annotated[int, Range(ge=16)] = 400
    """Maximum image width for the alignment, in pixels. Wider images are halved."""
    # Tracked poses are accurate to one or two pixels, so few levels suffice. With half of these
    # limits, alignment takes a quarter longer, and trajectories and maps are the same.
    dense: JointOptions = JointOptions(levels=2, small_translation_m=2e-4, small_rotation_rad=1e-4)


@dataclass(frozen=True)
class TrackingOptions:
    """Options of tracking."""

    kind: Literal["dense", "first-order"] = "dense"
    """Tracker: dense Gauss-Newton (dense) or the papers' Adam (first-order)."""
    dense: DenseOptions = DenseOptions()
    first_order: FirstOrderOptions = FirstOrderOptions()
    health: HealthLimits = HealthLimits()
