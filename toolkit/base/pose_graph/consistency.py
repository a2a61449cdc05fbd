"""Consistency of loops with the odometry and with each other, before the graph is solved.

A wrong loop aligns two different places that look the same. Two identical rooms pass every test
of appearance and shape, and all loops between them agree with each other. Pairwise consistency
(Mangelsen et al. 2018) is therefore not sufficient: the largest consistent set may be wrong. Only
the camera motion between the rooms distinguishes them. Odometry drifts by centimetres where the
rooms are metres apart, so each loop must first agree with the accumulated odometry within its
covariance. Only loops that pass this test are compared with each other. The test is valid while
the drift is smaller than the distance between the rooms, and while the covariances are not
smaller than the drift (`noise.OdometryNoise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.clique import largest_clique
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.base.pose_graph.options import PoseGraphOptions

Array = NDArray[np.float64]
# Number of loops up to which the largest consistent set is found exactly.
_EXACT_UP_TO = 40


def quantile(confidence: float, degrees: int) -> float:
    """Return the chi-square quantile for `degrees` degrees of freedom.

    Args:
        confidence: probability in (0, 1]; the quantile of 1 is infinite.
        degrees: degrees of freedom.
    """
    return 2.0 * float(gammaincinv(0.5 * degrees, confidence))


class OdometryChain:
    """A chain of odometry edges, with relative pose and covariance of any two nodes.

    Args:
        edges: odometry edges in order; each starts at the node where the previous one ends.
    """

    def __init__(self, edges: Sequence[PoseEdge]) -> None:
        nodes = [edges[0].first, *(edge.second for edge in edges)]
        self._index = {node: index for index, node in enumerate(nodes)}
        self._T_start_node = [np.eye(4)]
        # Cumulative covariance of edges 0..k-1 at node k, as perturbations at the start of the
        # chain. The covariance of any section is the difference of two entries.
        self._cumulative = [np.zeros((6, 6))]
        for edge in edges:
            T = se3.orthonormalise(self._T_start_node[-1] @ edge.T_first_second)
            A = se3.adjoint(T)
            self._T_start_node.append(T)
            self._cumulative.append(self._cumulative[-1] + A @ edge.covariance @ A.T)

    def __contains__(self, node: int) -> bool:
        return node in self._index

    def _at(self, node: int) -> int:
        return self._index[node]

    def motion(self, first: int, second: int) -> Array:
        """Relative pose T_first_second [4, 4] of two nodes from odometry."""
        T_first_start = se3.inverse(self._T_start_node[self._at(first)])
        return T_first_start @ self._T_start_node[self._at(second)]

    def covariance(self, first: int, second: int) -> Array:
        """[6, 6] covariance of x in T_first_second exp(x)."""
        A = se3.adjoint(se3.inverse(self._T_start_node[self._at(second)]))
        return A @ self._between(self._at(first), self._at(second)) @ A.T

    def loop_chi2(self, loop: PoseEdge) -> float:
        """Chi-square (6 degrees of freedom) of a loop against the odometry between its nodes.

        If the loop is true, the difference is the drift of the odometry, which its covariance
        must explain.
        """
        residual = se3.log(se3.inverse(loop.T_first_second) @ self.motion(loop.first, loop.second))
        covariance = self.covariance(loop.first, loop.second) + loop.covariance
        return _mahalanobis2(residual, covariance)

    def pair_chi2(self, a: PoseEdge, b: PoseEdge) -> float:
        """Chi-square (6 degrees of freedom) of the cycle through two loops.

        The cycle consists of loop a, odometry to loop b, the inverse of b, and odometry back to
        the start. Only the odometry between the adjacent ends of the loops enters, so two loops
        of neighbouring frames are compared more precisely than either with the odometry of
        the complete loop.
        """
        a, b = self._forward(a), self._forward(b)
        T_there = self.motion(a.second, b.second)
        T_back = self.motion(b.first, a.first)
        T_b_back = se3.inverse(b.T_first_second)
        residual = se3.log(a.T_first_second @ T_there @ T_b_back @ T_back)
        # Transform the error of each part to the end of the cycle.
        to_end_a = se3.adjoint(se3.inverse(T_there @ T_b_back @ T_back))
        # The inverse of b exp(x) is exp(-x) inverse(b): it perturbs the end of b.
        to_end_b = se3.adjoint(se3.inverse(T_b_back @ T_back))
        covariance = to_end_a @ a.covariance @ to_end_a.T + to_end_b @ b.covariance @ to_end_b.T
        covariance += self._odometry_covariance(a, b, T_b_back @ T_back)
        return _mahalanobis2(residual, covariance)

    def _odometry_covariance(self, a: PoseEdge, b: PoseEdge, T_b_end: Array) -> Array:
        """Covariance [6, 6] of both odometry sections of the cycle, at its end.

        Edges shared by both sections affect the cycle twice. Their Jacobians are added before
        the covariance is propagated.
        """
        forward = self._section(a.second, b.second, T_b_end)
        backward = self._section(b.first, a.first, np.eye(4))
        low, high = max(forward.low, backward.low), min(forward.high, backward.high)
        total = np.zeros((6, 6))
        for section in (forward, backward):
            pieces = [(section.low, section.high)]
            if low < high:
                pieces = [(section.low, low), (high, section.high)]
            for start, end in pieces:
                total += section.jacobian @ self._between(start, end) @ section.jacobian.T
        if low < high:
            both = forward.jacobian + backward.jacobian
            total += both @ self._between(low, high) @ both.T
        return total

    def _section(self, first: int, second: int, T_second_end: Array) -> _Section:
        """The odometry section between two nodes, with its Jacobian at the end of the cycle.

        Perturbations are expressed at the start of the chain, so all edges of a section have the
        same Jacobian. A section traversed backwards has the opposite sign.
        """
        start, end = self._at(first), self._at(second)
        T_end_start = se3.inverse(self._T_start_node[end] @ T_second_end)
        sign = 1.0 if start <= end else -1.0
        return _Section(min(start, end), max(start, end), sign * se3.adjoint(T_end_start))

    def _between(self, start: int, end: int) -> Array:
        low, high = min(start, end), max(start, end)
        return self._cumulative[high] - self._cumulative[low]

    def _forward(self, loop: PoseEdge) -> PoseEdge:
        """The loop, inverted if necessary to start at its earlier node, which shortens cycles."""
        earlier = self._at(loop.first) <= self._at(loop.second)
        return loop if earlier else loop.inverted()


@dataclass(frozen=True, eq=False)
class _Section:
    """Odometry edges low..high-1 and their Jacobian [6, 6] at the end of the cycle."""

    low: int
    high: int
    jacobian: Array


@dataclass(frozen=True, eq=False)
class ConsistentLoops:
    """The largest consistent set of loops.

    Attributes:
        kept: ascending indices of loops that agree with the odometry and with each other.
        odometry_chi2: [L] chi-square of each loop against the accumulated odometry.
        pair_chi2: [L, L] chi-square of each pair, 0 on the diagonal; NaN if either loop failed
            the odometry test.
        bound: maximum chi-square of consistent loops.
    """

    kept: tuple[int, ...]
    odometry_chi2: Array
    pair_chi2: Array
    bound: float

    def reason(self, index: int) -> str:
        """Return why a loop was rejected; empty for a kept loop."""
        if index in self.kept:
            return ""
        if self.odometry_chi2[index] > self.bound:
            return (
                f"chi-square {self.odometry_chi2[index]:.1f} against the odometry, "
                f"above {self.bound:.1f}"
            )
        against = sum(bool(self.pair_chi2[index, k] > self.bound) for k in self.kept)
        return f"inconsistent with {against} of {len(self.kept)} consistent loops"


def consistent_loops(
    chain: OdometryChain, loops: Sequence[PoseEdge], options: PoseGraphOptions | None = None
) -> ConsistentLoops:
    """Find the largest set of loops consistent with the odometry and pairwise with each other.

    Args:
        chain: odometry chain that contains both nodes of every loop.
        loops: existing and new loops.
        options: confidence levels; default if None.

    Raises:
        ValueError: a node of a loop is not on the chain.
    """
    count = len(loops)
    odometry_chi2 = np.array([chain.loop_chi2(loop) for loop in loops], dtype=np.float64)
    bound = quantile((options or PoseGraphOptions()).confidence, 6)
    # With this order, sets of equal size are resolved in favour of the odometry.
    order = np.argsort(odometry_chi2, kind="stable").tolist()
    plausible = [k for k in order if odometry_chi2[k] <= bound]
    pair_chi2 = np.full((count, count), np.nan)
    np.fill_diagonal(pair_chi2, 0.0)
    for i, a in enumerate(plausible):
        for b in plausible[:i]:
            pair_chi2[a, b] = pair_chi2[b, a] = chain.pair_chi2(loops[a], loops[b])
    agree = pair_chi2[np.ix_(plausible, plausible)] <= bound
    kept = sorted(plausible[k] for k in largest_clique(agree, _EXACT_UP_TO))
    return ConsistentLoops(tuple(kept), odometry_chi2, pair_chi2, bound)


def _mahalanobis2(residual: Array, covariance: Array) -> float:
    return float(residual @ np.linalg.solve(0.5 * (covariance + covariance.T), residual))
