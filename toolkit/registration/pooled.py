"""One motion from the pooled feature matches of many pairs of keyframes.

Two views with little overlap have too few matches for a reliable motion. Several such pairs between
the same two submaps share one motion, and their pooled matches can be sufficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.matching import Matched, match_features, rigid_fits
from toolkit.alignment.options import MatchingOptions
from toolkit.geometry import se3
from toolkit.keyframe import Keyframe

Array = NDArray[np.float64]

# With more pairs the inlier ratio is lower: more hypotheses are needed than for two images, and
# more matches are inliers by chance.
_MORE = 4
# Minimum number of inliers of a pair that supports the motion, and minimum number of such pairs.
_FEWEST_OF_A_PAIR, _FEWEST_PAIRS = 4, 2
_ROUNDS = 5


@dataclass(frozen=True)
class PooledMotion:
    """The motion with most inliers.

    Attributes:
        T_target_source: [4, 4].
        pairs: indices of the pairs that support it.
        matches: number of inliers.
    """

    T_target_source: Array
    pairs: list[int]
    matches: int


def pooled_motion(
    pairs: Sequence[tuple[Keyframe, Keyframe]],
    options: MatchingOptions,
    generator: np.random.Generator,
) -> PooledMotion | None:
    """T_target_source from the features of pairs (of the target, of the source), or None.

    The result needs at least two supporting pairs and twice the inliers of `measure_offset`.
    """
    found = [(place, match_features(*pair, options)) for place, pair in enumerate(pairs)]
    pool = [_Pooled(place, matched, *pairs[place]) for place, matched in found if matched]
    first = np.concatenate([p.in_target for p in pool] or [np.zeros((0, 3))])
    second = np.concatenate([p.in_source for p in pool] or [np.zeros((0, 3))])
    least = 2 * options.min_matches
    if len(first) < least:
        return None
    order = np.argsort(generator.random((_MORE * options.hypotheses, len(first))), axis=1)
    triples = order[:, :3]
    motions = rigid_fits(first[triples], second[triples])
    inliers = np.concatenate([p.inliers(motions, options) for p in pool], axis=1)
    best = inliers[int(np.argmax(inliers.sum(axis=1)))]
    T = np.eye(4)
    for _ in range(_ROUNDS):
        if best.sum() < least:
            return None
        T = rigid_fits(first[best][None], second[best][None])[0]
        best = np.concatenate([p.inliers(T[None], options)[0] for p in pool])
    counts = [int(p.inliers(T[None], options).sum()) for p in pool]
    agreeing = [p.place for p, n in zip(pool, counts, strict=True) if n >= _FEWEST_OF_A_PAIR]
    if best.sum() < least or len(agreeing) < _FEWEST_PAIRS:
        return None
    return PooledMotion(T, agreeing, int(best.sum()))


class _Pooled:
    """The matches of one pair in the coordinates of the submaps."""

    def __init__(self, place: int, matched: Matched, target: Keyframe, source: Keyframe) -> None:
        self.place, self._matched = place, matched
        self._T_camera_target = se3.inverse(target.T_map_camera)
        self._T_source_camera = source.T_map_camera
        self.in_target = se3.transform_points(target.T_map_camera, matched.first)
        self.in_source = se3.transform_points(source.T_map_camera, matched.second)

    def inliers(self, motions: Array, options: MatchingOptions) -> NDArray[np.bool_]:
        """Which matches are inliers [H, n] of which motions T_target_source [H, 4, 4]."""
        return self._matched.inliers(
            self._T_camera_target @ motions @ self._T_source_camera, options
        )
