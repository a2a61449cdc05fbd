"""Where one map lies in another: the submaps that look alike, registered and verified.

Two maps have no odometry between them that could contradict a registration. What can is another
registration: the pairs of submaps that are verified vote, and each votes for a motion of the
whole map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.loops.options import VerificationOptions
from toolkit.loops.verification import objection
from toolkit.registration.result import Registrar, RegistrationResult, register_pair
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]

# A pair of submaps is as alike as its so many most alike keyframes are on average.
_KEYFRAMES = 3


@dataclass(frozen=True)
class AlikeSubmaps:
    """A submap of each map, and the mean distance of their most alike keyframes' descriptors."""

    first: int
    second: int
    distance: float


@dataclass(frozen=True)
class MapRegistration:
    """What the registration of two submaps says of where their maps lie.

    Attributes:
        pair: the submaps.
        result: T_first_second of the submaps, and its figures.
        reason: why it is not believed, empty where it is.
        T_first_second: [4, 4] of the maps' worlds.
    """

    pair: AlikeSubmaps
    result: RegistrationResult
    reason: str
    T_first_second: Array

    def agrees_with(self, other: MapRegistration, most_m: float, most_rad: float) -> bool:
        """Whether both put the second map into the same place."""
        difference = se3.inverse(self.T_first_second) @ other.T_first_second
        angle = se3.rotation_angle_rad(difference[:3, :3])
        return bool(np.linalg.norm(difference[:3, 3]) <= most_m and angle <= most_rad)


def alike_submaps(
    first: Mapping[int, Submap], second: Mapping[int, Submap], count: int
) -> list[AlikeSubmaps]:
    """The pairs of submaps whose keyframes look most alike, the most alike first.

    Raises:
        ValueError: descriptors of the two maps differ in length.
    """
    descriptors = [{n: m[n].descriptors for n in m} for m in (first, second)]
    pairs = []
    for a, rows in descriptors[0].items():
        for b, others in descriptors[1].items():
            if 0 not in (*rows.shape, *others.shape):
                squares = np.maximum(2.0 - 2.0 * rows @ others.T, 0.0)
                nearest = np.sort(np.sqrt(squares.min(axis=1)))[:_KEYFRAMES]
                pairs.append(AlikeSubmaps(a, b, float(nearest.mean())))
    return sorted(pairs, key=lambda p: (p.distance, p.first, p.second))[:count]


def register_at(
    pair: AlikeSubmaps,
    first: Mapping[int, Submap],
    second: Mapping[int, Submap],
    registrar: Registrar,
    verification: VerificationOptions,
) -> MapRegistration:
    """Register a submap of each map from nothing, with a verdict.

    Raises:
        ToolkitError: a submap cannot be read.
    """
    a, b = first[pair.first], second[pair.second]
    result = register_pair(registrar, a, b)
    T = a.T_world_submap @ result.T_target_source @ se3.inverse(b.T_world_submap)
    return MapRegistration(pair, result, objection(result, verification), se3.orthonormalise(T))


@dataclass(frozen=True)
class Choice:
    """The registration that is believed, of so many verified ones, so many of which agree."""

    best: MapRegistration
    verified: int
    agreeing: int


def choose(
    found: list[MapRegistration], most_m: float = 0.2, most_rad: float = 0.1
) -> Choice | None:
    """Of those verified, the one that most others agree with; of equals, most surface in common.

    Args:
        most_m, most_rad: two that differ by less agree. Submaps far from each other differ by
            what both maps drifted between them.
    """
    verified = [f for f in found if not f.reason]
    if not verified:
        return None
    votes = [sum(f.agrees_with(other, most_m, most_rad) for other in verified) for f in verified]
    common = [f.result.overlap * f.result.inliers for f in verified]
    place = max(range(len(verified)), key=lambda i: (votes[i], common[i], -i))
    return Choice(verified[place], len(verified), votes[place])
