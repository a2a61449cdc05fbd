"""Published pose graphs: the optimum reached, beside that of GTSAM's own example. No times.

    SEMSPLAT_DATA=DATA python -m benchmarks.pose_graphs

Errors are half the sum of chi-squares, without kernels, from the chordal initialisation.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.machine import describe_machine
from toolkit.io.pose_graphs import read_pose_graph
from toolkit.pose_graph.files import graph_of
from toolkit.pose_graph.solver import SolverOptions, solve

# After InitializePose3 and Levenberg-Marquardt, as GTSAM's readG2o reads the files.
OPTIMA = {
    "tinyGrid3D": 9.3139,
    "smallGrid3D": 517.925,
    "parking-garage": 0.6342,
    "sphere2500": 675.701,
}
WITHIN = 1e-3


@dataclass(frozen=True)
class Options:
    """Solve the pose graphs of the literature."""

    only: tuple[str, ...] = ()
    """Names of graphs; all without it."""


def main() -> None:
    """Print one row a graph; exit with 1 if one misses its optimum."""
    options = tyro.cli(Options)
    folder = Path(os.environ["SEMSPLAT_DATA"]) / "pose_graphs"
    print(describe_machine(), flush=True)
    print("\n| graph | nodes | edges | at start | steps | error | known optimum | within 0.1 % |")
    print("|---|---:|---:|---:|---:|---:|---:|---|", flush=True)
    missed = False
    for name, optimum in OPTIMA.items():
        if options.only and name not in options.only:
            continue
        graph = graph_of(read_pose_graph(folder / f"{name}.g2o"))
        solver = SolverOptions(kernel="none", initialise=True)
        solution = solve(graph, solver, covariances=False)
        met = abs(solution.error_after - optimum) <= WITHIN * optimum
        missed |= not met
        print(
            f"| {name} | {len(graph.nodes)} | {len(graph.edges)} | {solution.error_before:.1f} "
            f"| {solution.iterations} | {solution.error_after:.4f} | {optimum} "
            f"| {'yes' if met else 'NO'} |",
            flush=True,
        )
    sys.exit(missed)


if __name__ == "__main__":
    main()
