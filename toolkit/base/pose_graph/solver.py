"""Pose graph optimisation with GTSAM; the only module that imports it.

GTSAM orders tangent vectors as (rotation, translation) and uses right perturbations, as we do.
`BetweenFactorPose3(i, j, Z)` measures Z = inverse(X_i) X_j. The solver runs on one thread, so
results are reproducible.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError, ToolkitError
from toolkit.base.pose_graph.graph import PoseGraph
from toolkit.base.pose_graph.options import Kernel

Array = NDArray[np.float64]

# (translation, rotation) <-> (rotation, translation); its own inverse.
_SWAP = np.array([3, 4, 5, 0, 1, 2])
# Standard deviation (m, rad) of the prior on the fixed node, which removes the gauge freedom. Its
# error is zero at the optimum; it only affects the covariances.
_FIXED_SIGMA = 1e-6
# Width of the robust kernels, in standard deviations. A correct edge of 6 degrees of freedom has
# 2.4 on average.
_KERNEL_WIDTH = 3.0
_ITERATIONS = 100
# Relative and absolute decrease of the error that ends the iterations.
_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class PoseGraphSolution:
    """Result of a pose graph optimisation.

    Attributes:
        T_world_node: [4, 4] float64 pose of each node; that of the fixed node is unchanged.
        chi2: [E] chi-square of each edge of the input graph, retracted edges included.
        weights: [E] robust kernel weights in [0, 1]; 0 for retracted edges.
        covariances: [N, 6, 6] of x in T_world_node exp(x), x = (translation m, rotation
            rad), nodes ascending; zero at the fixed node. None if not requested.
        error_before, error_after: GTSAM's error, half the sum of the (robust) chi-squares of the
            edges in use, at the initial poses and at the optimum.
        iterations: number of Levenberg-Marquardt iterations.
        converged: whether the tolerance was reached.
        retracted: indices of retracted loops in the graph's edges, in order of retraction.
    """

    T_world_node: dict[int, Array] = field(repr=False)
    chi2: Array = field(repr=False)
    weights: Array = field(repr=False)
    covariances: Array | None = field(repr=False)
    error_before: float
    error_after: float
    iterations: int
    converged: bool
    retracted: tuple[int, ...] = ()


def solve(
    graph: PoseGraph,
    kernel: Kernel = "cauchy",
    covariances: bool = True,
    initialise: bool = False,
) -> PoseGraphSolution:
    """Minimise the chi-squares of all edges by Levenberg-Marquardt.

    Args:
        graph: graph to optimise.
        kernel: robust kernel of loop edges.
        covariances: whether to compute covariances; takes seconds for thousands of nodes.
        initialise: start from the chordal initialisation instead of the current poses.

    Raises:
        DependencyError: GTSAM is not installed.
        ToolkitError: the system is singular to working precision.
    """
    gtsam = load_gtsam()
    factors = _factors(gtsam, graph, kernel)
    initial = _values(gtsam, graph)
    try:
        start = gtsam.InitializePose3.initialize(factors) if initialise else initial
        optimizer = gtsam.LevenbergMarquardtOptimizer(factors, start, _parameters(gtsam))
        values = optimizer.optimize()
        marginals = _covariances(gtsam, graph, factors, values) if covariances else None
    except RuntimeError as error:
        raise ToolkitError(
            f"the pose graph ({graph}) is singular to working precision; raise the smallest "
            f"variances of its edges, or lower the largest"
        ) from error

    poses = {node: np.array(values.atPose3(node).matrix()) for node in graph.nodes}
    poses[graph.anchor] = graph.T_world_node[graph.anchor].copy()
    chi2 = graph.chi2(poses)
    robust = np.array([edge.robust for edge in graph.edges], dtype=bool)
    steps = int(optimizer.iterations())
    return PoseGraphSolution(
        T_world_node=poses,
        chi2=chi2,
        weights=np.where(robust, kernel_weights(chi2, kernel), 1.0),
        covariances=marginals,
        error_before=float(factors.error(initial)),
        error_after=float(factors.error(values)),
        iterations=steps,
        converged=steps < _ITERATIONS,
    )


def kernel_weights(chi2: Array, kernel: Kernel) -> Array:
    """[E] robust kernel weights for chi-square values [E]."""
    width2 = _KERNEL_WIDTH**2
    if kernel == "huber":
        return np.minimum(1.0, _KERNEL_WIDTH / np.sqrt(np.maximum(chi2, 1e-300)))
    if kernel == "cauchy":
        return width2 / (width2 + chi2)
    if kernel == "geman-mcclure":
        return (width2 / (width2 + chi2)) ** 2
    return np.ones_like(chi2)


def load_gtsam() -> ModuleType:
    try:
        import gtsam
    except ImportError as error:
        raise DependencyError(
            f"pose graph optimisation needs GTSAM, which cannot be loaded ({error}); fix it with: "
            f"pip install 'gtsam>=4.3'"
        ) from error
    return gtsam


def _factors(gtsam: ModuleType, graph: PoseGraph, kernel: Kernel) -> Any:
    factors = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    pose = gtsam.Pose3(graph.T_world_node[graph.anchor])
    factors.add(gtsam.PriorFactorPose3(graph.anchor, pose, fixed))
    estimator = _estimator(gtsam, kernel)
    for edge in graph.edges:
        swapped = edge.information[np.ix_(_SWAP, _SWAP)]
        noise = gtsam.noiseModel.Gaussian.Information(swapped)
        if edge.robust and estimator is not None:
            noise = gtsam.noiseModel.Robust.Create(estimator, noise)
        measured = gtsam.Pose3(edge.T_first_second)
        factors.add(gtsam.BetweenFactorPose3(edge.first, edge.second, measured, noise))
    return factors


def _estimator(gtsam: ModuleType, kernel: Kernel) -> Any | None:
    estimators = gtsam.noiseModel.mEstimator
    kinds = {
        "huber": estimators.Huber,
        "cauchy": estimators.Cauchy,
        "geman-mcclure": estimators.GemanMcClure,
    }
    return None if kernel == "none" else kinds[kernel].Create(_KERNEL_WIDTH)


def _values(gtsam: ModuleType, graph: PoseGraph) -> Any:
    values = gtsam.Values()
    for node, T in graph.T_world_node.items():
        values.insert(node, gtsam.Pose3(T))
    return values


def _parameters(gtsam: ModuleType) -> Any:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setAbsoluteErrorTol(_TOLERANCE)
    return parameters


def _covariances(gtsam: ModuleType, graph: PoseGraph, factors: Any, values: Any) -> Array:
    marginals = gtsam.Marginals(factors, values)
    out = np.zeros((len(graph.nodes), 6, 6))
    for row, node in enumerate(graph.nodes):
        if node != graph.anchor:
            out[row] = marginals.marginalCovariance(node)[np.ix_(_SWAP, _SWAP)]
    return 0.5 * (out + out.transpose(0, 2, 1))
