"""Retraction of loops that contradict the rest of the graph after optimisation.

If all covariances are correct, the chi-square sum at the optimum has 6 degrees of freedom per edge
beyond a spanning tree, and a loop contributes 6 of them. Two tests follow:

- A loop is retracted if removing it lowers the chi-square sum by more than the quantile for 6
  degrees of freedom. This includes its own residual and the residuals it causes in the odometry.
- Several wrong loops may agree with each other (two rooms that look the same), so that no single
  one stands out. The odometry residuals then make the chi-square sum of the graph too large, and
  loops are removed until the sum is plausible.

The worst loop is removed first and the graph is solved again. Correct loops can be removed while a
wrong majority remains, so every retracted loop is tested once more at the end.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from toolkit.base.pose_graph.consistency import quantile
from toolkit.base.pose_graph.graph import PoseGraph
from toolkit.base.pose_graph.options import Kernel, PoseGraphOptions
from toolkit.base.pose_graph.solver import PoseGraphSolution, solve

_log = logging.getLogger(__name__)


class PoseGraphOptimiser:
    """Optimises pose graphs and retracts loops that contradict the rest."""

    def __init__(self, options: PoseGraphOptions | None = None) -> None:
        self.options = options or PoseGraphOptions()

    def optimise(self, graph: PoseGraph) -> PoseGraphSolution:
        """Optimise the graph and retract inconsistent loops.

        With L loops the graph is solved about L times, and again for each retracted loop.

        Raises:
            DependencyError: GTSAM is not installed.
            ToolkitError: the system is singular to working precision.
        """
        retracted = self._readmit(graph, self._retract(graph))
        for index in retracted:
            edge = graph.edges[index]
            _log.info(
                "Retracted loop %d-%d: it contradicts the rest of the graph",
                edge.first,
                edge.second,
            )
        solution = solve(graph.without(retracted), self.options.kernel)
        used = [k for k in range(len(graph.edges)) if k not in retracted]
        weights = np.zeros(len(graph.edges))
        weights[used] = solution.weights
        return replace(
            solution,
            chi2=graph.chi2(solution.T_world_node),
            weights=weights,
            retracted=tuple(retracted),
        )

    def _retract(self, graph: PoseGraph) -> list[int]:
        """Indices of the loops to retract, worst first."""
        retracted: list[int] = []
        while (worst := self._worst(_Trial.of(graph, retracted, self.options.kernel))) is not None:
            retracted.append(worst)
        return retracted

    def _worst(self, trial: _Trial) -> int | None:
        """Index of the loop to retract next, None if all loops can be kept."""
        loops = trial.removable_loops()
        if not loops:
            return None
        # Most wrong loops have a large residual of their own; test this before solving again.
        worst = max(loops, key=lambda k: trial.chi2[k])
        if trial.chi2[worst] > self._loop_bound:
            return worst
        reduction = {k: trial.total - trial.without(k).total for k in loops}
        worst = max(loops, key=lambda k: reduction[k])
        return worst if reduction[worst] > self._loop_bound or not self._plausible(trial) else None

    def _readmit(self, graph: PoseGraph, retracted: list[int]) -> list[int]:
        """Test each retracted loop again, best first; returns those that stay retracted."""
        trial = _Trial.of(graph, retracted, self.options.kernel)
        candidates = sorted(retracted, key=lambda k: trial.chi2[k]) if len(retracted) > 1 else []
        for index in candidates:
            again = trial.including(index)
            if again.total - trial.total <= self._loop_bound and self._plausible(again):
                trial = again
        return list(trial.retracted)

    @property
    def _loop_bound(self) -> float:
        """Maximum chi-square that one loop may add to the sum."""
        return quantile(self.options.confidence, 6)

    def _plausible(self, trial: _Trial) -> bool:
        """Whether the chi-square sum is plausible for its degrees of freedom."""
        degrees = trial.degrees_of_freedom
        return degrees == 0 or trial.total <= quantile(self.options.confidence, degrees)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A graph solved without the retracted edges.

    Attributes:
        graph: graph with all edges at the optimised poses.
        retracted: indices of the retracted edges.
        kernel: robust kernel of loop edges.
        chi2: [E] chi-square of all edges.
        total: chi-square sum of the edges in use.
    """

    graph: PoseGraph
    retracted: tuple[int, ...]
    kernel: Kernel
    chi2: np.ndarray
    total: float

    @classmethod
    def of(cls, graph: PoseGraph, retracted: Collection[int], kernel: Kernel) -> _Trial:
        solution = solve(graph.without(retracted), kernel, covariances=False)
        chi2 = graph.chi2(solution.T_world_node)
        used = np.setdiff1d(np.arange(len(chi2)), list(retracted))
        solved = graph.at(solution.T_world_node)
        return cls(solved, tuple(retracted), kernel, chi2, float(chi2[used].sum()))

    def without(self, index: int) -> _Trial:
        return _Trial.of(self.graph, (*self.retracted, index), self.kernel)

    def including(self, index: int) -> _Trial:
        rest = tuple(k for k in self.retracted if k != index)
        return _Trial.of(self.graph, rest, self.kernel)

    def removable_loops(self) -> list[int]:
        """Indices of loops in use whose removal keeps the graph connected."""
        loops = [k for k, edge in enumerate(self.graph.edges) if edge.kind == "loop"]
        return [
            k
            for k in loops
            if k not in self.retracted and self.graph.is_connected_without((*self.retracted, k))
        ]

    @property
    def degrees_of_freedom(self) -> int:
        used = len(self.graph.edges) - len(self.retracted)
        return 6 * (used - len(self.graph.nodes) + 1)
