"""Pose graph optimisation: accuracy, invariance, outliers and covariances."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pose_graph_files import graph_of, read_pose_graph
from walks import walk

from toolkit.base.errors import DependencyError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.pose_graph.graph import PoseEdge, PoseGraph, information_of
from toolkit.base.pose_graph.solver import _KERNEL_WIDTH, kernel_weights, solve

FEW = settings(deadline=None, max_examples=8)
seeds = st.integers(0, 2**16)
PLAIN = "none"


def all_loops(steps) -> list[PoseEdge]:
    return [steps.loop(k, k + 20) for k in range(8)]


@FEW
@given(seed=seeds)
def test_loops_remove_drift(seed: int) -> None:
    steps = walk(seed)
    graph = steps.graph(*all_loops(steps))
    solution = solve(graph)
    assert solution.converged
    assert solution.error_after < solution.error_before
    # The rounds through room A see each other: there the error is that of a few loops.
    assert steps.errors_m(solution.T_world_node)[20:].max() < 0.12
    before = np.sqrt(np.mean(steps.errors_m(graph.T_world_node) ** 2))
    assert np.sqrt(np.mean(steps.errors_m(solution.T_world_node) ** 2)) < max(before, 0.1)


@FEW
@given(seed=seeds)
def test_noise_free_edges_give_the_truth_from_any_start(seed: int) -> None:
    steps = walk(seed)
    truth = steps.T_world_node
    rng = np.random.default_rng(seed)
    ends = [(k, k + 1) for k in range(len(truth) - 1)] + [(27, 0), (4, 22)]
    edges = [
        PoseEdge(i, j, se3.inverse(truth[i]) @ truth[j], information_of(np.eye(6) * 1e-4))
        for i, j in ends
    ]
    start = {k: T @ se3.exp(0.05 * rng.normal(size=6)) for k, T in enumerate(truth)}
    start[0] = truth[0]
    solution = solve(PoseGraph(start, tuple(edges)), PLAIN)
    assert steps.errors_m(solution.T_world_node).max() < 1e-6
    assert solution.error_after < 1e-8


@FEW
@given(seed=seeds)
def test_solution_is_invariant_to_the_world_frame(seed: int) -> None:
    steps = walk(seed)
    graph = steps.graph(*all_loops(steps))
    T_other_world = se3.exp(np.random.default_rng(seed).normal(size=6) * [9, 9, 9, 1, 1, 1])
    moved = graph.at({n: T_other_world @ T for n, T in graph.T_world_node.items()})
    here, there = solve(graph), solve(moved)
    for node in graph.nodes:
        expected = T_other_world @ here.T_world_node[node]
        np.testing.assert_allclose(there.T_world_node[node], expected, atol=1e-5)
    np.testing.assert_allclose(there.chi2, here.chi2, atol=1e-3)
    # Covariances are expressed in the nodes' own frames.
    np.testing.assert_allclose(there.covariances, here.covariances, rtol=1e-2, atol=1e-8)


def test_solution_is_invariant_to_edge_direction_and_order() -> None:
    steps = walk(5)
    graph = steps.graph(*all_loops(steps))
    turned = PoseGraph(graph.T_world_node, tuple(e.inverted() for e in graph.edges[::-1]))
    here, there = solve(graph, PLAIN), solve(turned, PLAIN)
    for node in graph.nodes:
        np.testing.assert_allclose(there.T_world_node[node], here.T_world_node[node], atol=1e-4)


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy", "geman-mcclure"])
def test_the_error_is_half_the_sum_of_the_kernel(kernel: str) -> None:
    steps = walk(7)
    graph = steps.graph(*all_loops(steps), steps.twin_loop(1, 11))
    solution = solve(graph, kernel, covariances=False)
    assert solution.covariances is None
    assert solution.chi2 == pytest.approx(graph.chi2(solution.T_world_node))
    c, robust = solution.chi2, np.array([e.robust for e in graph.edges])
    k = _KERNEL_WIDTH
    rho = {
        "none": 0.5 * c,
        "huber": np.where(c <= k**2, 0.5 * c, k * (np.sqrt(c) - 0.5 * k)),
        "cauchy": 0.5 * k**2 * np.log1p(c / k**2),
        "geman-mcclure": 0.5 * k**2 * c / (k**2 + c),
    }[kernel]
    total = np.where(robust, rho, 0.5 * c).sum()
    assert solution.error_after == pytest.approx(total, rel=1e-6)
    # A kernel's weight is its slope over the residual.
    near = 1e-5 * np.maximum(c, 1e-3)
    slope = {
        "none": np.ones_like(c),
        "huber": np.where(c <= k**2, 1.0, k / np.sqrt(c)),
        "cauchy": k**2 * (np.log1p((c + near) / k**2) - np.log1p(c / k**2)) / near,
        "geman-mcclure": k**2 * ((c + near) / (k**2 + c + near) - c / (k**2 + c)) / near,
    }[kernel]
    np.testing.assert_allclose(solution.weights[robust], slope[robust], rtol=1e-3, atol=1e-9)
    assert (solution.weights[~robust] == 1).all()


@pytest.mark.parametrize("kernel", ["cauchy", "geman-mcclure"])
@FEW
@given(seed=seeds)
def test_kernels_suppress_wrong_loops(kernel: str, seed: int) -> None:
    steps = walk(seed)
    right = all_loops(steps)
    clean = solve(steps.graph(*right), kernel)
    wrong = [steps.twin_loop(k, 10 + k) for k in (0, 3, 6)]
    solution = solve(steps.graph(*right, *wrong), kernel)
    assert solution.weights[-3:].max() < 0.01
    assert (
        np.abs(steps.errors_m(solution.T_world_node) - steps.errors_m(clean.T_world_node)).max()
        < 0.05
    )
    # Without a kernel they bend the whole walk.
    bent = solve(steps.graph(*right, *wrong), PLAIN)
    assert steps.errors_m(bent.T_world_node).max() > 0.5


def test_covariances_match_samples() -> None:
    """A chain with one loop; translation first, in the node's frame."""
    errors = []
    for seed in range(80):
        steps = walk(seed)
        solution = solve(steps.graph(steps.loop(0, 20)), PLAIN, covariances=seed == 0)
        errors.append(se3.log(se3.inverse(steps.T_world_node[15]) @ solution.T_world_node[15]))
        if seed == 0:
            estimated = solution.covariances[15]
    measured = np.cov(np.array(errors).T)
    # In the estimated metric, the measured spread is the unit sphere, within that of 80 draws.
    L = np.linalg.cholesky(np.linalg.inv(estimated))
    spread = np.linalg.eigvalsh(L.T @ measured @ L)
    assert spread[0] > 0.45
    assert spread[-1] < 1.8


def test_chain_without_loops_keeps_poses_and_accumulates_covariance() -> None:
    steps = walk(11)
    graph = steps.graph()
    solution = solve(graph)
    assert solution.error_after < 1e-12
    assert (solution.covariances[0] == 0).all()
    np.testing.assert_allclose(solution.covariances[1], steps.odometry[0].covariance, atol=1e-10)
    assert (np.diff([np.trace(c[3:, 3:]) for c in solution.covariances]) > 0).all()
    for node, T in graph.T_world_node.items():
        np.testing.assert_allclose(solution.T_world_node[node], T, atol=1e-9)
    assert np.array_equal(solution.T_world_node[0], graph.T_world_node[0])


def test_any_node_can_be_fixed() -> None:
    steps = walk(12)
    graph = steps.graph(*all_loops(steps))
    other = PoseGraph(graph.T_world_node, graph.edges, fixed=13)
    solution = solve(other)
    assert np.array_equal(solution.T_world_node[13], graph.T_world_node[13])
    assert (solution.covariances[13] == 0).all()
    assert solution.covariances[0].trace() > 0


def digest() -> str:
    """Hash of all fields of a solution."""
    steps = walk(9)
    s = solve(steps.graph(*all_loops(steps), steps.twin_loop(1, 12)))
    parts = [np.stack(list(s.T_world_node.values())), s.chi2, s.weights, s.covariances]
    sums = np.array([s.error_before, s.error_after])
    return hashlib.sha256(b"".join(p.tobytes() for p in [*parts, sums])).hexdigest()


def test_solution_is_reproducible_in_another_process(request) -> None:
    program = "import sys; sys.path[:0] = sys.argv[1:]; import test_pose_graph_solver as t"
    folders = (str(request.path.parent), str(request.path.parents[2]))
    command = [sys.executable, "-c", program + "; print(t.digest())", *folders]
    environment = os.environ | {"OMP_NUM_THREADS": "2"}
    other = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert other.stdout.strip() == digest() == digest()


def test_missing_gtsam_error_names_the_package(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(DependencyError, match="pip install 'gtsam>="):
        solve(walk(1).graph())


def test_singular_graph_raises() -> None:
    edges = (PoseEdge(0, 1, np.eye(4), 1e-30 * np.eye(6)), PoseEdge(1, 2, np.eye(4), np.eye(6)))
    with pytest.raises(ToolkitError, match=r"pose graph \(3 nodes, .* raise the smallest"):
        solve(PoseGraph({k: np.eye(4) for k in range(3)}, edges))


def test_kernel_weights_at_zero_residual() -> None:
    for kernel in ("none", "huber", "cauchy", "geman-mcclure"):
        assert kernel_weights(np.zeros(2), kernel) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "nodes", "edges", "optimum"),
    [("tinyGrid3D", 9, 11, 9.3139), ("smallGrid3D", 125, 297, 517.925)],
)
def test_published_graphs_reach_their_optimum(real_data, name, nodes, edges, optimum) -> None:
    """The known optima of GTSAM's error, after its chordal initialisation."""
    graph = graph_of(read_pose_graph(real_data("pose_graphs") / f"{name}.g2o"))
    assert (len(graph.nodes), len(graph.edges)) == (nodes, edges)
    solution = solve(graph, "none", covariances=False, initialise=True)
    assert solution.error_after == pytest.approx(optimum, rel=1e-3)
    assert solution.converged
    assert 0.5 * solution.chi2.sum() == pytest.approx(optimum, rel=1e-3)
