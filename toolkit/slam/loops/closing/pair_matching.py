"""Relative pose of two keyframes that may show the same place, verified from their images alone.

A cheap test comes first: feature matches with depth, of which enough must agree with one motion.
What passes is aligned densely in both directions. The directions use different models, occlusions
and noise, so that a result of the wrong place is hardly ever confirmed by the other one. Errors
that both directions share, such as depth that was measured earlier than colour in a fast turn, are
found by the correlation of the images (`pair_evidence`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.slam.loops.closing.pair_evidence import EvidenceCollector, PairEvidence
from toolkit.splatting.alignment.matching import (
    KeypointCache,
    Offset,
    match_features,
    refine_offset,
)

Array = NDArray[np.float64]

# Minimum number of feature matches that agree with one motion. Fewer than for registration: the
# directions of alignment check each other.
_MIN_MATCHES = 8
# Maximum difference of the two directions of alignment. Those of correct pairs of real and
# synthetic sequences differ by 0.1 to 1.2 cm.
_MAX_DISAGREEMENT_M, _MAX_DISAGREEMENT_RAD = 0.02, 0.01
# Minimum fraction of a keyframe's image that the other one explains, in the better direction.
_MIN_VISIBLE = 0.35
# Maximum standard deviation of the relative position.
_MAX_SIGMA_M = 0.02
# Minimum normalised correlation of the aligned images: the median over textured blocks, in the
# worse of the two directions. Correct pairs have 0.7 to 0.99.
_MIN_CORRELATION = 0.65
# Maximum decrease of this correlation by dense alignment, from the pose of the matched features. In
# fast turns, depth that was measured at another time than colour pulls the pose away. Of forced
# pairs of fr1/rpy, 8 % lose more, of RedKitchen and HoloLens at most 1 %.
_MAX_LOST_CORRELATION = 0.04
# Maximum displacement of image blocks at the aligned pose: their median, in the worse direction. A
# rolling shutter bends images of fast turns, so that no pose aligns them. Correct pairs of exact
# images have 0.0003 to 0.001, of RedKitchen and HoloLens up to 0.0074; bent images of opposite
# turns by 100 to 200 degrees per second 0.006 to 0.016.
_MAX_DISPLACEMENT_RAD = 0.0075


@dataclass(frozen=True)
class RoughMotion:
    """Motion between two keyframes from their feature matches.

    Attributes:
        T_first_second: [4, 4].
        matches: number of matches that agree with it.
    """

    T_first_second: Array
    matches: int


@dataclass(frozen=True)
class VerifiedPair:
    """The relative pose of two keyframes, or the reason why it is not reliable.

    Attributes:
        matches: number of feature matches that agree with one motion; 0 if none was found.
        offset: relative pose; None if it was not estimated.
        reason: why it is rejected; empty if it is verified.
        evidence: similarity of the images; None if the alignment itself was rejected.
    """

    matches: int
    offset: Offset | None
    reason: str
    evidence: PairEvidence | None = None


class PairMatcher:
    """Verifies pairs of keyframes; keeps the keypoints of those it used last.

    Args:
        tests: whether the images must agree. Otherwise, the alignment of the second keyframe to
            the first one is the result.
    """

    def __init__(self, tests: bool = True) -> None:
        self._tests = tests
        self._keypoints = KeypointCache()
        self._evidence = EvidenceCollector()

    def rough(self, first: Keyframe, second: Keyframe) -> RoughMotion | None:
        """The motion from feature matches alone; None if too few agree."""
        matched = match_features(first, second, self._keypoints)
        if matched is None:
            return None
        motion = matched.motion(np.random.default_rng(0), _MIN_MATCHES)
        return None if motion is None else RoughMotion(*motion)

    def most_matches(
        self, pairs: Iterable[tuple[Keyframe, Keyframe]]
    ) -> list[tuple[int, RoughMotion]]:
        """Positions and motions of the pairs that pass the cheap test, most matches first."""
        rough = [(number, self.rough(*pair)) for number, pair in enumerate(pairs)]
        passed = [(number, motion) for number, motion in rough if motion is not None]
        return sorted(passed, key=lambda entry: -entry[1].matches)

    def verified(self, first: Keyframe, second: Keyframe, rough: RoughMotion) -> VerifiedPair:
        """Align two keyframes densely in both directions."""
        forward = refine_offset(first, second, rough.T_first_second, rough.matches)
        if forward is None:
            return VerifiedPair(rough.matches, None, "dense alignment of the images failed")
        if not self._tests:
            return VerifiedPair(rough.matches, forward, "")
        T_second_first = se3.inverse(rough.T_first_second)
        backward = refine_offset(second, first, T_second_first, rough.matches)
        if backward is None:
            reason = "dense alignment of the images failed in the other direction"
            return VerifiedPair(rough.matches, forward, reason)
        offset, reason = _mean(forward, backward), _rejection(forward, backward)
        if reason:
            return VerifiedPair(rough.matches, offset, reason)
        evidence = self._evidence.of(first, second, offset.T_first_second, rough.T_first_second)
        return VerifiedPair(rough.matches, offset, _contradiction(evidence), evidence)


def _rejection(forward: Offset, backward: Offset) -> str:
    """Why an offset is not reliable; empty if it is."""
    difference = se3.log(forward.T_first_second @ backward.T_first_second)
    metres, radians = np.linalg.norm(difference[:3]), np.linalg.norm(difference[3:])
    if metres > _MAX_DISAGREEMENT_M or radians > _MAX_DISAGREEMENT_RAD:
        degrees = np.degrees(radians)
        return f"the directions differ by {100 * metres:.1f} cm and {degrees:.1f} degrees"
    visible = max(forward.visible, backward.visible)
    if visible < _MIN_VISIBLE:
        return f"only {100 * visible:.0f} % of the view is shared"
    sigma_m = translation_sigma_m(forward.information)
    if not sigma_m < _MAX_SIGMA_M:
        return f"the position is uncertain by {100 * sigma_m:.1f} cm"
    return ""


def _contradiction(evidence: PairEvidence) -> str:
    """Why the images contradict an offset; empty if they do not."""
    correlation, lost = evidence.correlation, evidence.lost_correlation
    if correlation < _MIN_CORRELATION:
        return f"the aligned images correlate by {correlation:.2f} only"
    if lost > _MAX_LOST_CORRELATION:
        before = correlation + lost
        return (
            f"colour and depth disagree: the images correlate by {before:.2f} at the pose of "
            f"their features, and by {correlation:.2f} after dense alignment"
        )
    displacement = evidence.displacement_rad
    if displacement > _MAX_DISPLACEMENT_RAD:
        degrees = np.degrees(displacement)
        return f"parts of the images are displaced by {degrees:.2f} degrees, as if bent"
    return ""


def translation_sigma_m(information: Array) -> float:
    """Largest standard deviation of the translation; infinite if it is unknown."""
    values, vectors = np.linalg.eigh(information)
    if not values[0] > 0:
        return float("inf")
    covariance = (vectors / values) @ vectors.T
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def _mean(forward: Offset, backward: Offset) -> Offset:
    """The pose halfway between both directions, whose biases are opposite."""
    difference = se3.log(forward.T_first_second @ backward.T_first_second)
    # forward^-1 backward^-1 = exp(-d) conjugated; half of it from the left.
    T = se3.exp(-0.5 * difference) @ forward.T_first_second
    visible = max(forward.visible, backward.visible)
    return replace(forward, T_first_second=se3.orthonormalise(T), visible=visible)
