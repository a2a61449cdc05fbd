"""Loops taken back after optimisation, where they and the rest cannot both be right.

If every covariance is right, the graph's chi-square at the optimum is that of 6 degrees of
freedom for each edge beyond a tree, and a loop adds that of 6. Both are tested:

- A loop is refused by the rest if the sum over the graph falls by more than its share when
  the loop is left out. This holds its own residual, and what it bends the odometry by.
- Several wrong loops may agree (two rooms that look the same), and each then explains the
  others. What gives them away is the odometry, which they strain together: the sum over the
  whole graph is too large, and goes on being so until the last of them is gone.

The worst goes first, and the rest is solved again. Loops that agreed with the truth can fall
to a wrong majority on the way, so at the end each one taken back is tried again.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from toolkit.pose_graph.chi_square import quantile
from toolkit.pose_graph.graph import PoseGraph
from toolkit.pose_graph.options import RetractionOptions, SolverOptions
from toolkit.pose_graph.solver import PoseGraphSolution, solve

_log = logging.getLogger(__name__)


class PoseGraphOptimiser:
    """Solves pose graphs and takes back loops that contradict the rest."""

    def __init__(
        self,
        solver: SolverOptions | None = None,
        retraction: RetractionOptions | None = None,
    ) -> None:
        self.solver = solver or SolverOptions()
        self.retraction = retraction or RetractionOptions()

    def optimise(self, graph: PoseGraph) -> PoseGraphSolution:
        """The poses that agree best, without the loops that had to go.

        With L loops this solves the graph about L times, and again for each that goes.

        Raises:
            DependencyError: GTSAM is missing.
            ToolkitError: the system is singular to working precision.
        """
        retracted = self._readmit(graph, self._retract(graph))
        for place in retracted:
            edge = graph.edges[place]
            _log.info("loop %d-%d contradicts the rest, taken back", edge.first, edge.second)
        solution = solve(graph.without(retracted), self.solver)
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
        """Places of the loops to take back, worst first."""
        retracted: list[int] = []
        while (worst := self._worst(_Trial.of(graph, retracted, self.solver))) is not None:
            retracted.append(worst)
        return retracted

    def _worst(self, trial: _Trial) -> int | None:
        """Place of the loop that has to go first; None where all may stay."""
        loops = trial.dispensable_loops()
        if not loops:
            return None
        # Most wrong loops show without being left out.
        worst = max(loops, key=lambda k: trial.chi2[k])
        if trial.chi2[worst] > self._share:
            return worst
        saved = {k: trial.total - trial.leaving_out(k).total for k in loops}
        worst = max(loops, key=lambda k: saved[k])
        return worst if saved[worst] > self._share or not self._plausible(trial) else None

    def _readmit(self, graph: PoseGraph, retracted: list[int]) -> list[int]:
        """What stays taken back when each loop has a second chance, the best first."""
        trial = _Trial.of(graph, retracted, self.solver)
        waiting = sorted(retracted, key=lambda k: trial.chi2[k]) if len(retracted) > 1 else []
        for place in waiting:
            again = trial.taking_in(place)
            if again.total - trial.total <= self._share and self._plausible(again):
                trial = again
        return list(trial.retracted)

    @property
    def _share(self) -> float:
        """What one loop may add to the sum."""
        return quantile(self.retraction.confidence, 6)

    def _plausible(self, trial: _Trial) -> bool:
        """Whether a sum is one that its degrees of freedom explain."""
        degrees = trial.degrees_of_freedom
        return degrees == 0 or trial.total <= quantile(self.retraction.confidence, degrees)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A graph solved without some of its edges.

    Attributes:
        graph: with all its edges, at the poses found.
        retracted: places of the edges left out.
        chi2: [E] of all edges.
        total: sum of those that are used.
    """

    graph: PoseGraph
    retracted: tuple[int, ...]
    solver: SolverOptions
    chi2: np.ndarray
    total: float

    @classmethod
    def of(cls, graph: PoseGraph, retracted: Collection[int], solver: SolverOptions) -> _Trial:
        solution = solve(graph.without(retracted), solver, covariances=False)
        chi2 = graph.chi2(solution.T_world_node)
        used = np.setdiff1d(np.arange(len(chi2)), list(retracted))
        found = graph.at(solution.T_world_node)
        return cls(found, tuple(retracted), solver, chi2, float(chi2[used].sum()))

    def leaving_out(self, place: int) -> _Trial:
        return _Trial.of(self.graph, (*self.retracted, place), self.solver)

    def taking_in(self, place: int) -> _Trial:
        rest = tuple(k for k in self.retracted if k != place)
        return _Trial.of(self.graph, rest, self.solver)

    def dispensable_loops(self) -> list[int]:
        """Loops in use without which the graph still hangs together."""
        loops = [k for k, edge in enumerate(self.graph.edges) if edge.kind == "loop"]
        return [
            k
            for k in loops
            if k not in self.retracted and self.graph.holds_without((*self.retracted, k))
        ]

    @property
    def degrees_of_freedom(self) -> int:
        used = len(self.graph.edges) - len(self.retracted)
        return 6 * (used - len(self.graph.nodes) + 1)
