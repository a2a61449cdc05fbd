"""Options of alignment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from toolkit.options import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt, Range


@dataclass(frozen=True)
class HealthLimits:
    """Limits beyond which a tracked frame counts as doubtful or lost."""

    min_measured: PositiveInt = 200
    """Minimum number of pixels with a depth measurement."""
    min_visible: Fraction = 0.15
    """Minimum fraction of the measured pixels that the map explains."""
    max_intensity_residual: PositiveFloat = 0.15
    """Maximum robust scale of the photometric residuals, for intensities in [0, 1]."""
    max_depth_residual_m: PositiveFloat = 0.04
    """Maximum robust scale of the depth residuals at a depth of 1 m, in metres."""
    min_information: NonNegativeFloat = 1e4
    """Minimum eigenvalue of the pose's information matrix, in 1/m^2 and 1/rad^2."""
    # On a blank wall with 1 % of noise it is below 0.015, in recordings of weak texture above 0.05.
    min_rise: NonNegativeFloat = 0.03
    """Minimum relative rise of the cost at 5 cm or 2 degrees from the pose, for frames with little
    texture. Below it, the pose of the frame is doubtful."""
    min_correlation: Fraction = 0.6
    """Minimum median correlation of the textures of a frame and the map. Below it, the pose of the
    frame is doubtful."""
    min_agreement: Fraction = 0.75
    """Minimum fraction of a frame's depth that agrees with the map, where the map covers it. Below
    it, the pose of the frame is doubtful."""
    min_covered: Fraction = 0.15
    """Minimum fraction of a frame's depth that the map covers. Below it, the pose of the frame is
    doubtful."""


@dataclass(frozen=True)
class JointOptions:
    """Joint dense Gauss-Newton alignment of pairs of views."""

    levels: Annotated[int, Range(ge=1, le=7)] = 4
    """Number of image pyramid levels of the first pass."""
    iterations: PositiveInt = 12
    """Maximum number of Gauss-Newton iterations per pyramid level."""
    max_distance: PositiveFloat = 0.05
    """Maximum depth difference of corresponding pixels at the finest pyramid level, as a fraction
    of depth. It doubles with every coarser level."""
    exposure: bool = True
    """Estimate the exposure (gain and bias) of each pair at the finest pyramid level."""
    geometric_weight: PositiveFloat = 1.0
    """Weight of the geometric term relative to the photometric term at the finest pyramid
    level."""
    max_translation_m: PositiveFloat = 0.2
    """Maximum translation per iteration, in metres."""
    max_rotation_rad: PositiveFloat = 0.2
    """Maximum rotation per iteration, in radians."""
    small_translation_m: PositiveFloat = 1e-4
    """Translation per iteration below which the finest level has converged, in metres."""
    small_rotation_rad: PositiveFloat = 5e-5
    """Rotation per iteration below which the finest level has converged, in radians."""


@dataclass(frozen=True)
class MatchingOptions:
    """Relative pose of two keyframes from their images: SIFT matches, then dense alignment."""

    features: Annotated[int, Range(ge=3)] = 1500
    """Maximum number of SIFT features per image."""
    ratio: Annotated[float, Range(gt=0, le=1)] = 0.8
    """Maximum ratio of the descriptor distances of the nearest and the second nearest match."""
    hypotheses: PositiveInt = 500
    """Number of RANSAC hypotheses, each from three matches."""
    tolerance_rad: PositiveFloat = 0.008
    """Maximum direction error of an inlier, in radians; at least 1.5 pixels of the coarser
    camera."""
    tolerance_depth: PositiveFloat = 0.05
    """Maximum depth error of an inlier, as a fraction of depth."""
    min_matches: Annotated[int, Range(ge=3)] = 12
    """Minimum number of inlier matches."""
    # Where a sensor's depth is not registered to its colour image, as in 7-Scenes, the depth at a
    # feature may be that of another surface: correct motions were corrected by 5 % of the width.
    max_correction: Fraction = 0.08
    """Maximum median shift of the points by dense alignment, as a fraction of the image's width."""
    max_width: Annotated[int, Range(ge=16)] = 400
    """Maximum image width for dense alignment, in pixels. Wider images are halved."""
    # Matches are accurate to one or two pixels, so that few levels suffice.
    dense: JointOptions = JointOptions(levels=3)
    limits: HealthLimits = HealthLimits()
