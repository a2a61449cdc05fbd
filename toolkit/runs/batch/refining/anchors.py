"""Poses of submaps from the registrations of overlapping pairs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.consistency import OdometryChain, consistent_loops, quantile
from toolkit.base.pose_graph.graph import PoseEdge, information_of
from toolkit.base.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.base.pose_graph.options import PoseGraphOptions
from toolkit.base.pose_graph.retraction import PoseGraphOptimiser
from toolkit.base.pose_graph.solver import solve
from toolkit.runs.batch.refining.tasks import Extent, PairResult
from toolkit.slam.loops.closing.options import ClosingOptions, LoopClosureOptions
from toolkit.slam.loops.correction import PoseCorrection, submap_graph

# Of more loops, each is compared with the odometry and with the robust solution of all. Comparing
# every pair and solving once without each takes 19 s for 77 loops, and grows with the square.
_MAX_COMPARED = 60

Array = NDArray[np.float64]
Pair = tuple[int, int]

# Information of the end of an odometry edge: the alignment of its last frame is as accurate as an
# alignment can be, because earlier loop closures have corrected the poses.
_ALIGNED = 1e12 * np.eye(6)


@dataclass(frozen=True)
class Anchors:
    """Corrected poses.

    Attributes:
        T_world_submap: [4, 4] by number.
        used: registrations that the poses agree with.
        largest_m: largest translation of a submap, metres.
    """

    T_world_submap: Mapping[int, Array]
    used: frozenset[Pair]
    largest_m: float


def possible_pairs(extents: Mapping[int, Extent]) -> list[Pair]:
    """Return the pairs of submaps whose boxes intersect, as ascending numbers."""
    numbers = sorted(extents)
    low = np.array([extents[n].low for n in numbers])
    high = np.array([extents[n].high for n in numbers])
    pairs = []
    for k in range(1, len(numbers)):
        meets = ((low[:k] <= high[k]) & (high[:k] >= low[k])).all(axis=1)
        pairs += [(numbers[i], numbers[k]) for i in np.flatnonzero(meets)]
    return sorted(pairs)


def chosen_pairs(overlaps: Mapping[Pair, float], options: ClosingOptions) -> list[Pair]:
    """Choose the pairs to register by descending overlap, as at the end of a run.

    A pair is chosen while one of its submaps has fewer than `max_partners` partners.
    """
    chosen: list[Pair] = []
    partners: Counter[int] = Counter()
    for pair in sorted(overlaps, key=lambda pair: (-overlaps[pair], pair)):
        fewest = min(partners[number] for number in pair)
        if overlaps[pair] >= options.min_visible and fewest < options.max_partners:
            chosen.append(pair)
            partners.update(pair)
    return sorted(chosen)


def corrected_anchors(
    anchors: Mapping[int, Array],
    extents: Mapping[int, Extent],
    results: Sequence[PairResult],
    options: LoopClosureOptions,
) -> Anchors:
    """Optimise the poses of submaps over odometry and verified registrations.

    Poses stay as they are unless a registration contradicts them: those of a run that closed its
    loops are more accurate than a single registration.
    """
    numbers = sorted(anchors)
    index = {number: k for k, number in enumerate(numbers)}
    noise = OdometryNoise()
    links = []
    for a, b in pairwise(numbers):
        covariance = noise.covariance(_ALIGNED, extents[a].path_m, extents[a].path_rad)
        T_a_b = se3.orthonormalise(se3.inverse(anchors[a]) @ anchors[b])
        links.append(PoseEdge(index[a], index[b], T_a_b, information_of(covariance)))
    loop_noise = LoopNoise()
    accepted = [result for result in results if not result.reason]
    loops = [
        loop_noise.edge(
            index[r.first], index[r.second], r.result.T_target_source, r.result.information
        )
        for r in accepted
    ]
    bound = quantile(options.closing.drift_confidence, 6)
    T = [anchors[number] for number in numbers]
    if all(loop.chi2(T[loop.first], T[loop.second]) <= bound for loop in loops):
        return Anchors(dict(anchors), frozenset(), 0.0)
    poses = {index[n]: T for n, T in anchors.items()}
    correction, kept = _corrected(poses, links, loops, options.pose_graph)
    used = frozenset((numbers[loop.first], numbers[loop.second]) for loop in kept)
    T_new = {n: np.array(correction.T_new[index[n]]) for n in numbers}
    return Anchors(T_new, used, correction.largest_m)


def _corrected(
    poses: Mapping[int, Array],
    links: Sequence[PoseEdge],
    loops: Sequence[PoseEdge],
    options: PoseGraphOptions,
) -> tuple[PoseCorrection, list[PoseEdge]]:
    """Optimise the graph; return the correction and the loops that it agrees with."""
    chain = OdometryChain(links)
    if len(loops) <= _MAX_COMPARED:
        kept = [loops[k] for k in consistent_loops(chain, loops, options).kept]
        graph = submap_graph(poses, links, kept)
        solution = PoseGraphOptimiser(options).optimise(graph)
        retracted = [graph.edges[k] for k in solution.retracted]
        kept = [loop for loop in kept if not any(loop is edge for edge in retracted)]
        return PoseCorrection.of(graph, solution), kept
    bound = quantile(options.confidence, 6)
    kept = [loop for loop in loops if chain.loop_chi2(loop) <= bound]
    while True:
        graph = submap_graph(poses, links, kept)
        solution = solve(graph, options.kernel, covariances=False)
        T = solution.T_world_node
        agreeing = [loop for loop in kept if loop.chi2(T[loop.first], T[loop.second]) <= bound]
        if len(agreeing) == len(kept):
            return PoseCorrection.of(graph, solution), kept
        kept = agreeing
