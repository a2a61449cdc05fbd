"""Which loops can be true together, told from the odometry before any graph is solved.

A wrong loop lays two places on each other that look the same: two identical rooms pass every
test that looks at pictures and shapes, and each of their loops agrees with all the others of
the same pair of rooms. Agreement among loops (pairwise consistency, Mangelsen et al. 2018)
therefore proves nothing by itself: the largest set that agrees may be the wrong one. What
tells twins apart is that the camera walked from one to the other. Odometry drifts by
centimetres where the rooms are metres apart, so each loop has to agree with the accumulated
odometry first, within its covariance, and only those that do are compared with each other.
That protects as long as the drift is smaller than the distance of the look-alikes, and as
long as the covariances are no smaller than the drift (`noise.OdometryNoise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.pose_graph.chi_square import quantile
from toolkit.pose_graph.clique import largest_clique
from toolkit.pose_graph.graph import PoseEdge
from toolkit.pose_graph.options import ConsistencyOptions

Array = NDArray[np.float64]


class OdometryChain:
    """Odometry from node to node, and what it says of any two of them.

    Args:
        edges: odometry in order, each from where the last one ended.

    Raises:
        ValueError: an edge does not start where the one before it ends, or a node comes twice.
    """

    def __init__(self, edges: Sequence[PoseEdge]) -> None:
        if not edges:
            raise ValueError("a chain of odometry needs at least one edge")
        for edge, following in pairwise(edges):
            if edge.second != following.first:
                raise ValueError(f"odometry breaks off: {following} does not follow {edge}")
        nodes = [edges[0].first, *(edge.second for edge in edges)]
        self._place = {node: place for place, node in enumerate(nodes)}
        if len(self._place) != len(nodes):
            raise ValueError("odometry comes through one node twice")
        self._T_start_node = [np.eye(4)]
        # Covariance of each edge as a perturbation of the chain's start, summed up, so that
        # any piece of the chain is a difference: at node k the edges 0..k-1.
        self._summed = [np.zeros((6, 6))]
        for edge in edges:
            T = se3.orthonormalise(self._T_start_node[-1] @ edge.T_first_second)
            A = se3.adjoint(T)
            self._T_start_node.append(T)
            self._summed.append(self._summed[-1] + A @ edge.covariance @ A.T)

    def __contains__(self, node: int) -> bool:
        return node in self._place

    def _at(self, node: int) -> int:
        if node not in self._place:
            raise ValueError(f"node {node} is not on the chain of odometry")
        return self._place[node]

    def motion(self, first: int, second: int) -> Array:
        """T_first_second [4, 4] between two nodes, as odometry has it."""
        T_first_start = se3.inverse(self._T_start_node[self._at(first)])
        return T_first_start @ self._T_start_node[self._at(second)]

    def covariance(self, first: int, second: int) -> Array:
        """[6, 6] covariance of x in T_first_second exp(x)."""
        A = se3.adjoint(se3.inverse(self._T_start_node[self._at(second)]))
        return A @ self._between(self._at(first), self._at(second)) @ A.T

    def loop_chi2(self, loop: PoseEdge) -> float:
        """Disagreement of one loop with the odometry between its ends (6 degrees of freedom).

        It asks whether the loop could be true at all: odometry has drifted by the
        difference, and its covariance says how far it may have.
        """
        residual = se3.log(se3.inverse(loop.T_first_second) @ self.motion(loop.first, loop.second))
        covariance = self.covariance(loop.first, loop.second) + loop.covariance
        return _squared_length(residual, covariance)

    def pair_chi2(self, a: PoseEdge, b: PoseEdge) -> float:
        """Disagreement of two loops with each other (6 degrees of freedom).

        The cycle goes over loop a, by odometry to loop b, back over b and by odometry to
        where it began; it should close. Odometry between the near ends alone enters, so two
        loops of neighbouring frames are compared far more sharply than either with the whole
        way around.
        """
        a, b = self._forward(a), self._forward(b)
        T_there = self.motion(a.second, b.second)
        T_back = self.motion(b.first, a.first)
        T_b_back = se3.inverse(b.T_first_second)
        residual = se3.log(a.T_first_second @ T_there @ T_b_back @ T_back)
        # Each part's error, carried to the end of the cycle.
        to_end_a = se3.adjoint(se3.inverse(T_there @ T_b_back @ T_back))
        # The inverse of b exp(x) is exp(-x) inverse(b): its error sits where b ends.
        to_end_b = se3.adjoint(se3.inverse(T_b_back @ T_back))
        covariance = to_end_a @ a.covariance @ to_end_a.T + to_end_b @ b.covariance @ to_end_b.T
        covariance += self._two_ways(a, b, T_b_back @ T_back)
        return _squared_length(residual, covariance)

    def _two_ways(self, a: PoseEdge, b: PoseEdge, T_b_end: Array) -> Array:
        """Covariance [6, 6] of both ways by odometry at the cycle's end.

        Where the ways share edges, as between loops that follow each other, each of these
        acts twice: its two effects are added before they are squared.
        """
        there = self._way(a.second, b.second, T_b_end)
        back = self._way(b.first, a.first, np.eye(4))
        low, high = max(there.low, back.low), min(there.high, back.high)
        total = np.zeros((6, 6))
        for way in (there, back):
            pieces = [(way.low, way.high)]
            if low < high:
                pieces = [(way.low, low), (high, way.high)]
            for start, end in pieces:
                total += way.effect @ self._between(start, end) @ way.effect.T
        if low < high:
            both = there.effect + back.effect
            total += both @ self._between(low, high) @ both.T
        return total

    def _way(self, first: int, second: int, T_second_end: Array) -> _Way:
        """The way from one node to another, and how its edges move the cycle's end.

        An edge's perturbation, told at the chain's start, moves the end the same way
        wherever on the way it lies; walked backwards, with the other sign.
        """
        start, end = self._at(first), self._at(second)
        T_end_start = se3.inverse(self._T_start_node[end] @ T_second_end)
        sign = 1.0 if start <= end else -1.0
        return _Way(min(start, end), max(start, end), sign * se3.adjoint(T_end_start))

    def _between(self, start: int, end: int) -> Array:
        low, high = min(start, end), max(start, end)
        return self._summed[high] - self._summed[low]

    def _forward(self, loop: PoseEdge) -> PoseEdge:
        """The loop told from the earlier of its nodes, so that cycles stay short."""
        earlier = self._at(loop.first) <= self._at(loop.second)
        return loop if earlier else loop.inverted()


@dataclass(frozen=True, eq=False)
class _Way:
    """Odometry edges low..high-1, and their effect [6, 6] on a cycle's end."""

    low: int
    high: int
    effect: Array


@dataclass(frozen=True, eq=False)
class ConsistentLoops:
    """Which loops can be true together.

    Attributes:
        kept: places of the loops that agree with the odometry and each other, ascending.
        odometry_chi2: [L] of each loop against the accumulated odometry.
        pair_chi2: [L, L] of each pair, 0 on the diagonal; NaN where either loop had already
            failed against the odometry.
        odometry_bound, pair_bound: what these must not exceed.
    """

    kept: tuple[int, ...]
    odometry_chi2: Array
    pair_chi2: Array
    odometry_bound: float
    pair_bound: float

    def reason(self, place: int) -> str:
        """Why a loop was left out; empty for one that was kept."""
        if place in self.kept:
            return ""
        if self.odometry_chi2[place] > self.odometry_bound:
            return (
                f"chi-square {self.odometry_chi2[place]:.1f} against the odometry, "
                f"above {self.odometry_bound:.1f}"
            )
        against = sum(bool(self.pair_chi2[place, k] > self.pair_bound) for k in self.kept)
        return f"contradicts {against} of the {len(self.kept)} loops that agree"


def consistent_loops(
    chain: OdometryChain, loops: Sequence[PoseEdge], options: ConsistencyOptions | None = None
) -> ConsistentLoops:
    """The largest set of loops that agree with the odometry and pairwise with each other.

    Args:
        chain: odometry that passes both ends of every loop.
        loops: those held already as well as new ones.

    Raises:
        ValueError: a loop ends at a node that is not on the chain.
    """
    options = options or ConsistencyOptions()
    count = len(loops)
    odometry_chi2 = np.array([chain.loop_chi2(loop) for loop in loops], dtype=np.float64)
    odometry_bound = quantile(options.odometry_confidence, 6)
    # In this order equally large sets are decided in favour of the odometry.
    order = np.argsort(odometry_chi2, kind="stable").tolist()
    plausible = [k for k in order if odometry_chi2[k] <= odometry_bound]
    pair_chi2 = np.full((count, count), np.nan)
    np.fill_diagonal(pair_chi2, 0.0)
    for i, a in enumerate(plausible):
        for b in plausible[:i]:
            pair_chi2[a, b] = pair_chi2[b, a] = chain.pair_chi2(loops[a], loops[b])
    pair_bound = quantile(options.pair_confidence, 6)
    agree = pair_chi2[np.ix_(plausible, plausible)] <= pair_bound
    kept = sorted(plausible[k] for k in largest_clique(agree, options.exact_up_to))
    return ConsistentLoops(tuple(kept), odometry_chi2, pair_chi2, odometry_bound, pair_bound)


def _squared_length(residual: Array, covariance: Array) -> float:
    return float(residual @ np.linalg.solve(0.5 * (covariance + covariance.T), residual))
