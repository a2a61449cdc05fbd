"""Published pose graphs: the error reached, and that of GTSAM's own example.

SEMSPLAT_DATA=DATA python -m benchmarks.pose_graphs
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.pose_graph_files import graph_of, read_pose_graph
from benchmarks.recordings import Recording
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Table
from toolkit.base.pose_graph.solver import solve

# After InitializePose3 and Levenberg-Marquardt, as GTSAM's readG2o reads the files.
OPTIMA = {
    "tinyGrid3D": 9.3139,
    "smallGrid3D": 517.925,
    "parking-garage": 0.6342,
    "sphere2500": 675.701,
}
WITHIN = 1e-3


DESCRIPTION = """\
Errors are half the sum of chi-squares, without robust kernels, after the chordal initialisation and
Levenberg-Marquardt. The optimum is that of GTSAM's own example on the same files."""


@dataclass(frozen=True)
class Options:
    """Solve the pose graphs of the literature."""

    out: Path = RESULTS
    """Folder of the results file."""


def main() -> None:
    """Measure one row for each graph; exit with 1 if one misses its optimum."""
    options = tyro.cli(Options)
    header = current_header((), ("toolkit/base/pose_graph",))
    folder = Recording("", "pose_graphs").path
    rows = []
    missed = False
    for name, optimum in OPTIMA.items():
        graph = graph_of(read_pose_graph(folder / f"{name}.g2o"))
        solution = solve(graph, "none", covariances=False, initialise=True)
        met = abs(solution.error_after - optimum) <= WITHIN * optimum
        missed |= not met
        cells = (len(graph.nodes), len(graph.edges), f"{solution.error_before:.1f}")
        errors = (solution.iterations, f"{solution.error_after:.4f}", optimum)
        rows.append((name, *map(str, (*cells, *errors)), "yes" if met else "**no**"))
    columns = ("graph", "nodes", "edges", "at start", "iterations", "error", "optimum")
    table = Table((*columns, "within 0.1 %"), tuple(rows))
    publish(Results("pose-graphs", "Pose graphs", DESCRIPTION, header, (table,)), options.out)
    sys.exit(missed)


if __name__ == "__main__":
    main()
