"""Registration of two maps: similar submaps are registered, verified and compared.

There is no odometry between two maps, so a registration can only be checked against other
registrations. Every verified pair of submaps yields a transformation between the maps, and the
transformation that most pairs agree with is selected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.result import Registrar, RegistrationResult, register_pair
from toolkit.slam.loops.verification import rejection_reason
from toolkit.slam.submaps.submap import Submap

Array = NDArray[np.float64]

# The distance of two submaps is the mean over this many nearest keyframe pairs.
_KEYFRAMES = 3


# Maximum difference of registrations that agree. Registrations of distant submaps differ by the
# drift of both maps between them.
_MAX_DIFFERENCE_M, _MAX_DIFFERENCE_RAD = 0.2, 0.1


@dataclass(frozen=True)
class SubmapPair:
    """A submap of each map.

    Attributes:
        first, second: submap numbers.
        distance: mean descriptor distance of their most similar keyframes.
    """

    first: int
    second: int
    distance: float


@dataclass(frozen=True)
class MapRegistration:
    """Transformation between two maps from the registration of one submap pair.

    Attributes:
        pair: registered submaps.
        result: registration of the submaps.
        reason: why verification rejected it; empty if verified.
        T_first_second: [4, 4] transformation between the world frames of the maps.
    """

    pair: SubmapPair
    result: RegistrationResult
    reason: str
    T_first_second: Array

    def agrees_with(self, other: MapRegistration) -> bool:
        """Whether both transformations differ by little."""
        difference = se3.inverse(self.T_first_second) @ other.T_first_second
        distance_m = np.linalg.norm(difference[:3, 3])
        angle_rad = se3.rotation_angle_rad(difference[:3, :3])
        return bool(distance_m <= _MAX_DIFFERENCE_M and angle_rad <= _MAX_DIFFERENCE_RAD)


def most_similar_submaps(
    first: Mapping[int, Submap], second: Mapping[int, Submap], count: int
) -> list[SubmapPair]:
    """Return the submap pairs with the most similar keyframes, most similar first.

    Raises:
        ValueError: the descriptors of the two maps differ in length.
    """
    descriptors = [{n: m[n].descriptors for n in m} for m in (first, second)]
    pairs = []
    for a, rows in descriptors[0].items():
        for b, others in descriptors[1].items():
            if 0 not in (*rows.shape, *others.shape):
                squares = np.maximum(2.0 - 2.0 * rows @ others.T, 0.0)
                nearest = np.sort(np.sqrt(squares.min(axis=1)))[:_KEYFRAMES]
                pairs.append(SubmapPair(a, b, float(nearest.mean())))
    return sorted(pairs, key=lambda p: (p.distance, p.first, p.second))[:count]


def register_submaps(
    pair: SubmapPair,
    first: Mapping[int, Submap],
    second: Mapping[int, Submap],
    registrar: Registrar,
) -> MapRegistration:
    """Register and verify one submap pair without an initial guess.

    Raises:
        ToolkitError: a submap cannot be read.
    """
    a, b = first[pair.first], second[pair.second]
    result = register_pair(registrar, a, b)
    T = a.T_world_submap @ result.T_target_source @ se3.inverse(b.T_world_submap)
    return MapRegistration(pair, result, rejection_reason(result), se3.orthonormalise(T))


@dataclass(frozen=True)
class SelectedRegistration:
    """The selected registration.

    Attributes:
        best: the registration that most others agree with.
        verified: number of verified registrations.
        agreeing: number of verified registrations that agree with `best`, itself included.
    """

    best: MapRegistration
    verified: int
    agreeing: int


def select_registration(found: list[MapRegistration]) -> SelectedRegistration | None:
    """Select the verified registration with the most agreement, then the most common surface."""
    verified = [f for f in found if not f.reason]
    if not verified:
        return None
    votes = [sum(f.agrees_with(other) for other in verified) for f in verified]
    common = [f.result.overlap * f.result.inliers for f in verified]
    index = max(range(len(verified)), key=lambda i: (votes[i], common[i], -i))
    return SelectedRegistration(verified[index], len(verified), votes[index])
