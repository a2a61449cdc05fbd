"""Options of loop closure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from toolkit.features.options import FeatureOptions
from toolkit.loops.options import (
    CandidateOptions,
    LandmarkOptions,
    RelocalisationOptions,
    VerificationOptions,
)
from toolkit.loops.pose_graph.options import PoseGraphOptions
from toolkit.loops.registration.options import RegistrationOptions
from toolkit.options import Fraction, NonNegativeInt, PositiveFloat, Range


@dataclass(frozen=True)
class PairOptions:
    """Requirements that the images of two keyframes must meet to become a loop."""

    # The directions of correct pairs of real and synthetic sequences differ by 0.1 to 1.2 cm.
    max_disagreement_m: PositiveFloat = 0.02
    """Maximum difference of the two directions of alignment, in metres."""
    max_disagreement_rad: PositiveFloat = 0.01
    """Maximum difference of the two directions of alignment, in radians."""
    min_matches: Annotated[int, Range(ge=3)] = 8
    """Minimum number of feature matches that agree with one motion."""
    min_visible: Fraction = 0.35
    """Minimum fraction of a keyframe's image that the other one explains, in the better of the two
    directions."""
    max_sigma_m: PositiveFloat = 0.02
    """Maximum standard deviation of the relative position, in metres."""
    # Correct pairs have 0.7 to 0.99.
    min_correlation: Fraction = 0.65
    """Minimum normalised correlation of the aligned images: the median over textured blocks, in the
    worse of the two directions."""
    # Of forced pairs of fr1/rpy, 8 % lose more, of RedKitchen and HoloLens at most 1 %.
    max_lost_correlation: PositiveFloat = 0.04
    """Maximum decrease of this correlation by dense alignment, from the pose of the matched
    features. In fast turns, depth that was measured at another time than colour pulls the pose
    away."""
    # Correct pairs of exact images have 0.0003 to 0.001, of RedKitchen and HoloLens up to 0.0074;
    # bent images of opposite turns by 100 to 200 degrees per second 0.006 to 0.016.
    max_displacement_rad: PositiveFloat = 0.0075
    """Maximum displacement of image blocks at the aligned pose, in radians: their median, in the
    worse of the two directions. A rolling shutter bends images of fast turns, so that no pose
    aligns them."""


@dataclass(frozen=True)
class ClosingOptions:
    """Which loops are closed."""

    within: bool = True
    """Close loops between keyframes of one submap."""
    between: bool = True
    """Close loops between submaps by registration."""
    min_visible: Fraction = 0.4
    """Minimum overlap of two submaps' views for registering them at the end of a run."""
    pairs: PairOptions = PairOptions()
    max_image_difference_m: PositiveFloat = 0.05
    """Maximum distance of a registration's result from the pose of a verified pair of keyframes,
    in metres."""
    max_image_difference_rad: PositiveFloat = 0.035
    """Maximum angle between a registration's result and the pose of a verified pair of keyframes,
    in radians."""
    min_shared: Fraction = 0.3
    """Minimum fraction of a candidate keyframe's view that the other keyframe sees after the
    registration of their submaps."""
    # Of many small submaps in a room, every pair overlaps, and registering all of them would take
    # longer than the recording.
    max_partners: NonNegativeInt = 8
    """Maximum number of overlapping submaps that each submap is registered with at the end of a
    run, in addition to those that a loop connects it to."""
    # An image pair is accurate to a centimetre; a well tracked map is more accurate, and would only
    # be disturbed.
    drift_confidence: Annotated[float, Range(gt=0, lt=1)] = 0.99
    """Confidence with which loops must contradict the keyframes of a submap before these are
    moved."""
    mapping_iterations: NonNegativeInt = 10
    """Number of mapping iterations, at fixed poses, per keyframe that a correction inside a submap
    has moved (GauSem-SLAM: 10)."""


@dataclass(frozen=True)
class LoopClosureOptions:
    """Loop detection and closure."""

    use: bool = True
    """Detect and close loops."""
    features: FeatureOptions = FeatureOptions()
    candidates: CandidateOptions = CandidateOptions()
    landmarks: LandmarkOptions = LandmarkOptions()
    registration: RegistrationOptions = RegistrationOptions()
    verification: VerificationOptions = VerificationOptions()
    closing: ClosingOptions = ClosingOptions()
    relocalisation: RelocalisationOptions = RelocalisationOptions()
    pose_graph: PoseGraphOptions = PoseGraphOptions()
