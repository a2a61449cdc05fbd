"""Options of loop closure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from toolkit.base.options import Fraction, NonNegativeInt, Range
from toolkit.base.pose_graph.options import PoseGraphOptions
from toolkit.semantics.features.options import FeatureOptions
from toolkit.slam.loops.options import (
    CandidateOptions,
    LandmarkOptions,
    ObjectOptions,
    RelocalisationOptions,
)


@dataclass(frozen=True)
class ClosingOptions:
    """Which loops are closed."""

    within: bool = True
    """Close loops between keyframes of one submap."""
    between: bool = True
    """Close loops between submaps by registration."""
    min_visible: Fraction = 0.4
    """Minimum overlap of two submaps' views for registering them at the end of a run."""
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
    verify: bool = True
    """Reject registrations of submaps that overlap too little, whose surfaces, colours or classes
    disagree, or that are not determined, and pairs of keyframes whose images do not match in both
    directions. Otherwise, all that converge become loops."""
    features: FeatureOptions = FeatureOptions()
    candidates: CandidateOptions = CandidateOptions()
    landmarks: LandmarkOptions = LandmarkOptions()
    objects: ObjectOptions = ObjectOptions()
    closing: ClosingOptions = ClosingOptions()
    relocalisation: RelocalisationOptions = RelocalisationOptions()
    pose_graph: PoseGraphOptions = PoseGraphOptions()
