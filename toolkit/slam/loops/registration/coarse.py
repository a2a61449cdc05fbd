"""Coarse registration: a motion from pairs of keyframes with similar descriptors (G-5).

The paper assumes that similar views have equal poses. In general they do not, so the relative pose
Z of every pair is measured: `T T_source = T_target Z`. Robust averaging rejects wrong pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.slam.loops.registration.motion_average import MotionAverage, average_motion
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.pooled import pooled_motion
from toolkit.slam.loops.registration.result import UNKNOWN, RegistrationResult, failed
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.data import ResidualScales
from toolkit.splatting.alignment.matching import Offset, measure_offset

Array = NDArray[np.float64]

# Minimum number of keyframe pairs that agree.
_MIN_AGREEING = 2
# Number of agreeing keyframe pairs after which no more are measured.
_ENOUGH = 4
# Maximum number of keyframe pairs whose feature matches are pooled if no pair determines its offset
# alone. Where submaps overlap little, the most similar keyframes often show different places.
_POOLED_PAIRS = 40


@dataclass(frozen=True)
class KeyframePair:
    """Two keyframes with similar descriptors, by their positions in their submaps."""

    target: int
    source: int
    distance: float


@dataclass(frozen=True)
class CoarseRegistration:
    """A coarse result, and the source keyframes of its inliers in order of descending weight."""

    result: RegistrationResult
    views: list[int]


def descriptor_pairs(target: Submap, source: Submap, count: int) -> list[KeyframePair]:
    """The pairs of keyframes with the closest descriptors, in rounds, closest first.

    The pairs of a round are one-to-one: no keyframe occurs twice. Short submaps fill the count by
    further rounds over the remaining pairs, because the most similar views are not always those
    that can be matched. Empty without descriptors.
    """
    a, b = target.descriptors, source.descriptors
    if 0 in (*a.shape, *b.shape):
        return []
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2.0 * a @ b.T
    distances = np.sqrt(np.maximum(squares, 0.0))
    order = np.argsort(distances, axis=None, kind="stable")
    remaining = [(int(index) // len(b), int(index) % len(b)) for index in order]
    pairs: list[KeyframePair] = []
    while remaining and len(pairs) < count:
        used: tuple[set[int], set[int]] = set(), set()
        skipped = []
        for i, j in remaining:
            if i in used[0] or j in used[1]:
                skipped.append((i, j))
                continue
            pairs.append(KeyframePair(i, j, float(distances[i, j])))
            used[0].add(i)
            used[1].add(j)
        remaining = skipped
    return pairs[:count]


def register_coarse(
    target: Submap,
    source: Submap,
    options: RegistrationOptions,
    generator: np.random.Generator,
    start: Array | None = None,
) -> CoarseRegistration:
    """Estimate T_target_source from similar keyframes; no initial value is needed.

    Args:
        start: an additional initial value of T_target_source [4, 4].
    """
    pairs = descriptor_pairs(target, source, options.views)
    if not pairs:
        return CoarseRegistration(failed("coarse", "no keyframe has a descriptor", start), [])
    usable: list[tuple[KeyframePair, Offset]] = []
    average, tried = None, 0
    for pair in pairs:
        tried += 1
        offset = _offset(pair, target, source, options, generator)
        if offset is None:
            continue
        usable.append((pair, offset))
        if len(usable) >= _ENOUGH and options.offsets == "measured":
            average = _average(target, source, usable, options, start)
            if average.inliers.sum() >= _ENOUGH:
                break
    if average is None or len(average.inliers) < len(usable):
        average = _average(target, source, usable, options, start) if usable else None
    if average is None or average.inliers.sum() < _least(options):
        pooled = _pooled(target, source, options, generator)
        if pooled is not None:
            return pooled
    if average is None:
        reason = f"none of {tried} similar pairs of keyframes determines an offset"
        return CoarseRegistration(failed("coarse", reason, start), [])
    ranked = np.argsort(-average.weights, kind="stable")
    views = [usable[i][0].source for i in ranked if average.inliers[i]]
    offsets = [offset for _, offset in usable]
    result = _result(average, offsets, tried, _least(options))
    return CoarseRegistration(result, list(dict.fromkeys(views)))


def _least(options: RegistrationOptions) -> int:
    """Minimum number of pairs that agree: without measured offsets (G-5), there is no test."""
    return _MIN_AGREEING if options.offsets == "measured" else 1


def _average(
    target: Submap,
    source: Submap,
    usable: list[tuple[KeyframePair, Offset]],
    options: RegistrationOptions,
    start: Array | None,
) -> MotionAverage:
    T_target_camera = np.array(
        [target.keyframes[p.target].T_map_camera @ z.T_first_second for p, z in usable]
    )
    T_source_camera = np.array([source.keyframes[p.source].T_map_camera for p, _ in usable])
    return average_motion(T_target_camera, T_source_camera, start, options.agree_within)


def _pooled(
    target: Submap,
    source: Submap,
    options: RegistrationOptions,
    generator: np.random.Generator,
) -> CoarseRegistration | None:
    """A motion estimated from the features of many pairs together; no pair suffices alone."""
    if options.offsets == "none":
        return None
    pairs = descriptor_pairs(target, source, _POOLED_PAIRS)
    keyframes = [(target.keyframes[p.target], source.keyframes[p.source]) for p in pairs]
    found = pooled_motion(keyframes, generator)
    if found is None:
        return None
    T_source_camera = np.array([keyframes[index][1].T_map_camera for index in found.pairs])
    T_target_camera = found.T_target_source @ T_source_camera
    average = average_motion(T_target_camera, T_source_camera, agree_within=options.agree_within)
    unknown = Offset(np.eye(4), 0, float("nan"), UNKNOWN, np.zeros((6, 6)))
    result = _result(average, [unknown] * len(found.pairs), len(pairs), _MIN_AGREEING)
    views = [pairs[index].source for index in found.pairs]
    return CoarseRegistration(result, list(dict.fromkeys(views)))


def _offset(
    pair: KeyframePair,
    target: Submap,
    source: Submap,
    options: RegistrationOptions,
    generator: np.random.Generator,
) -> Offset | None:
    if options.offsets == "none":
        return Offset(np.eye(4), 0, float("nan"), UNKNOWN, np.zeros((6, 6)))
    first, second = target.keyframes[pair.target], source.keyframes[pair.source]
    return measure_offset(first, second, generator)


def _result(
    average: MotionAverage, offsets: list[Offset], tried: int, least: int
) -> RegistrationResult:
    agreeing = int(average.inliers.sum())
    enough = agreeing >= least
    kept = [offset for offset, agrees in zip(offsets, average.inliers, strict=True) if agrees]
    return RegistrationResult(
        T_target_source=average.T_target_source,
        converged=enough and average.converged,
        inliers=agreeing / tried,
        residual=ResidualScales(
            _median([offset.residual.intensity for offset in kept]),
            _median([offset.residual.depth_m for offset in kept]),
        ),
        overlap=_median([offset.visible for offset in kept]),
        class_agreement=float("nan"),
        information=average.information,
        iterations=average.iterations,
        renders=0,
        method="coarse",
        reason="" if enough else f"only {agreeing} of {tried} similar pairs of keyframes agree",
    )


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
