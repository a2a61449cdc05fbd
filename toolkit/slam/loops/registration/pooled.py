"""One motion from the pooled feature matches of many pairs of keyframes.

Two views with little overlap have too few matches for a reliable motion. Several such pairs between
the same two submaps share one motion, and their pooled matches can be sufficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.splatting.alignment.matching import (
    HYPOTHESES,
    MIN_MATCHES,
    KeypointCache,
    Matched,
    match_features,
    rigid_fits,
)

Array = NDArray[np.float64]

# Factor of the number of hypotheses relative to a single pair of images: with more pairs, the
# inlier ratio is lower.
_HYPOTHESES_FACTOR = 4
# Factor of the minimum number of inliers: with more pairs, more matches are inliers by chance.
_MATCHES_FACTOR = 2
# Minimum number of inliers of a pair that supports the motion, and minimum number of such pairs.
_MIN_PAIR_INLIERS, _MIN_PAIRS = 4, 2
_ROUNDS = 5


@dataclass(frozen=True)
class PooledMotion:
    """The motion with the most inliers.

    Attributes:
        T_target_source: [4, 4].
        pairs: indices of the pairs that support it.
        matches: number of inliers.
    """

    T_target_source: Array
    pairs: list[int]
    matches: int


def pooled_motion(
    pairs: Sequence[tuple[Keyframe, Keyframe]], generator: np.random.Generator
) -> PooledMotion | None:
    """Estimate T_target_source from the features of pairs of (target, source) keyframes.

    Returns:
        The motion. None unless at least two pairs support it, with twice the number of inliers
        that `measure_offset` requires.
    """
    keypoints = KeypointCache(2 * len(pairs))
    found = [(i, match_features(*pair, keypoints)) for i, pair in enumerate(pairs)]
    pool = [_PairMatches(index, matched, *pairs[index]) for index, matched in found if matched]
    first = np.concatenate([p.in_target for p in pool] or [np.zeros((0, 3))])
    second = np.concatenate([p.in_source for p in pool] or [np.zeros((0, 3))])
    min_matches = _MATCHES_FACTOR * MIN_MATCHES
    if len(first) < min_matches:
        return None
    hypotheses = _HYPOTHESES_FACTOR * HYPOTHESES
    triples = np.argsort(generator.random((hypotheses, len(first))), axis=1)[:, :3]
    motions = rigid_fits(first[triples], second[triples])
    inliers = np.concatenate([p.inliers(motions) for p in pool], axis=1)
    best = inliers[int(np.argmax(inliers.sum(axis=1)))]
    T = np.eye(4)
    for _ in range(_ROUNDS):
        if best.sum() < min_matches:
            return None
        T = rigid_fits(first[best][None], second[best][None])[0]
        best = np.concatenate([p.inliers(T[None])[0] for p in pool])
    counts = [int(p.inliers(T[None]).sum()) for p in pool]
    supporting = [p.index for p, n in zip(pool, counts, strict=True) if n >= _MIN_PAIR_INLIERS]
    if best.sum() < min_matches or len(supporting) < _MIN_PAIRS:
        return None
    return PooledMotion(T, supporting, int(best.sum()))


class _PairMatches:
    """The matches of one pair in the coordinates of the submaps."""

    def __init__(self, index: int, matched: Matched, target: Keyframe, source: Keyframe) -> None:
        self.index, self._matched = index, matched
        self._T_camera_target = se3.inverse(target.T_map_camera)
        self._T_source_camera = source.T_map_camera
        self.in_target = se3.transform_points(target.T_map_camera, matched.first)
        self.in_source = se3.transform_points(source.T_map_camera, matched.second)

    def inliers(self, motions: Array) -> NDArray[np.bool_]:
        """Mask [H, n] of the matches that are inliers of motions T_target_source [H, 4, 4]."""
        return self._matched.inliers(self._T_camera_target @ motions @ self._T_source_camera)
