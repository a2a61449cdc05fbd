"""Similarity graphs: poses with a scale each, as in monocular maps (Strasdat et al. 2010)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.pose_graph.solver import load_gtsam

Array = NDArray[np.float64]

_ITERATIONS = 100
# Standard deviation of the first node, which is held.
_FIXED_SIGMA = 1e-6
# Deviations above it, in standard deviations, have linear cost: 95 % efficient for normal errors.
# Cauchy's and DCS's kernels can reject a true loop entirely if much scale drift must be undone.
_HUBER = 1.345


@dataclass(frozen=True, eq=False)
class SimilarityEdge:
    """A relative similarity of two nodes, p_first = scale * R_first_second p_second + t.

    Attributes:
        first, second: node numbers.
        T_first_second: [4, 4], with the translation in the first node's unit.
        scale: units of the first node per unit of the second one.
        rotation_sigma_rad, translation_sigma, log_scale_sigma: standard deviations; that of the
            translation in the second node's unit.
        robust: whether large deviations have linear cost.
    """

    first: int
    second: int
    T_first_second: Array = field(repr=False)
    scale: float
    rotation_sigma_rad: float
    translation_sigma: float
    log_scale_sigma: float
    robust: bool = False


@dataclass(frozen=True, eq=False)
class SimilaritySolution:
    """Result of an optimisation.

    Attributes:
        T_world_node: poses [4, 4] of the nodes; that of the first is unchanged.
        scale: [N] world units per unit of each node.
        error_before, error_after: half the sum of the (robust) squared deviations.
    """

    T_world_node: list[Array]
    scale: Array
    error_before: float
    error_after: float


def solve_similarities(
    T_world_node: Sequence[Array], edges: Sequence[SimilarityEdge]
) -> SimilaritySolution:
    """Minimise the deviations of all edges over poses and scales; the initial scales are 1.

    Raises:
        DependencyError: GTSAM is not installed.
        ToolkitError: the system is singular to working precision.
    """
    gtsam = load_gtsam()
    estimators = gtsam.noiseModel.mEstimator
    initial = gtsam.Values()
    for node, T in enumerate(T_world_node):
        initial.insert(node, gtsam.Similarity3(gtsam.Rot3(T[:3, :3]), T[:3, 3], 1.0))
    factors = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(7, _FIXED_SIGMA)
    factors.add(gtsam.PriorFactorSimilarity3(0, initial.atSimilarity3(0), fixed))
    for edge in edges:
        T, scale = edge.T_first_second, edge.scale
        # GTSAM's similarity maps p to scale * (R p + t).
        measured = gtsam.Similarity3(gtsam.Rot3(T[:3, :3]), T[:3, 3] / scale, scale)
        sigmas = [edge.rotation_sigma_rad] * 3 + [edge.translation_sigma] * 3
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([*sigmas, edge.log_scale_sigma]))
        if edge.robust:
            noise = gtsam.noiseModel.Robust.Create(estimators.Huber.Create(_HUBER), noise)
        factors.add(gtsam.BetweenFactorSimilarity3(edge.first, edge.second, measured, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    try:
        values = gtsam.LevenbergMarquardtOptimizer(factors, initial, parameters).optimize()
    except RuntimeError as error:
        raise ToolkitError("the similarity graph is singular to working precision") from error
    solved = [values.atSimilarity3(node) for node in range(len(T_world_node))]
    scales = np.array([X.scale() for X in solved])
    poses = [
        se3.from_rotation_translation(X.rotation().matrix(), X.scale() * X.translation())
        for X in solved
    ]
    poses[0] = np.array(T_world_node[0])
    return SimilaritySolution(
        poses, scales, float(factors.error(initial)), float(factors.error(values))
    )
