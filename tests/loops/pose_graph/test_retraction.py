"""Retraction of inconsistent loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from walks import Walk, walk

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.consistency import quantile
from toolkit.base.pose_graph.graph import PoseEdge, information_of
from toolkit.base.pose_graph.options import PoseGraphOptions
from toolkit.base.pose_graph.retraction import PoseGraphOptimiser
from toolkit.base.pose_graph.solver import solve

FEW = settings(deadline=None, max_examples=3)
seeds = st.integers(0, 2**16)
PLAIN = PoseGraphOptimiser(PoseGraphOptions(kernel="none"))


def retracted_loops(steps: Walk, optimiser: PoseGraphOptimiser, loops: list[PoseEdge]) -> set[int]:
    """Indices of retracted loops; checks that the poses equal those of the graph without them."""
    graph = steps.graph(*loops)
    solution = optimiser.optimise(graph)
    offset = len(steps.odometry)
    places = {k - offset for k in solution.retracted}
    assert len(places) == len(solution.retracted)
    assert (solution.weights[list(solution.retracted)] == 0).all()
    assert len(solution.chi2) == len(solution.weights) == len(graph.edges)
    rest = solve(
        steps.graph(*(e for k, e in enumerate(loops) if k not in places)), optimiser.options.kernel
    )
    for node, T in rest.T_world_node.items():
        np.testing.assert_allclose(solution.T_world_node[node], T, atol=1e-9)
    np.testing.assert_allclose(solution.covariances, rest.covariances, atol=1e-12)
    return places


@FEW
@given(seed=seeds)
def test_correct_loops_are_kept(seed: int) -> None:
    steps = walk(seed)
    loops = [steps.loop(k, 20 + k) for k in range(0, 8, 2)]
    assert retracted_loops(steps, PoseGraphOptimiser(), loops) == set()


@pytest.mark.parametrize("optimiser", [PoseGraphOptimiser(), PLAIN], ids=["cauchy", "plain"])
@FEW
@given(seed=seeds)
def test_single_wrong_loop_is_retracted(optimiser: PoseGraphOptimiser, seed: int) -> None:
    steps = walk(seed)
    loops = [steps.loop(1, 21), steps.twin_loop(2, 12), steps.loop(5, 25)]
    assert retracted_loops(steps, optimiser, loops) == {1}


@pytest.mark.parametrize("optimiser", [PoseGraphOptimiser(), PLAIN], ids=["cauchy", "plain"])
@FEW
@given(seed=seeds)
def test_consistent_majority_of_wrong_loops_is_retracted(
    optimiser: PoseGraphOptimiser, seed: int
) -> None:
    steps = walk(seed)
    wrong = [steps.twin_loop(k, 10 + k) for k in (0, 2, 4, 6)]
    loops = [*wrong, steps.loop(1, 21), steps.loop(5, 25)]
    assert retracted_loops(steps, optimiser, loops) == {0, 1, 2, 3}


@FEW
@given(seed=seeds)
def test_wrong_loop_with_small_residual_is_retracted(seed: int) -> None:
    """Without a kernel the odometry absorbs the error, and the loop's own chi-square is small."""
    steps = walk(seed)
    off = steps.loop(1, 21).T_first_second @ se3.exp(np.array([0.0, 0.9, 0, 0, 0, 0]))
    loop = PoseEdge.loop(1, 21, off, information_of(1e-7 * np.eye(6)))
    graph = steps.graph(loop)
    solution = solve(graph, PLAIN.options.kernel)
    assert solution.chi2[-1] < 1.0
    assert retracted_loops(steps, PLAIN, [loop]) == {0}


def shifted(steps: Walk, first: int, second: int, shift_m: float, sigma: float) -> PoseEdge:
    """A precise loop with a translation error."""
    T_wrong_world = np.eye(4)
    T_wrong_world[1, 3] = shift_m
    T = se3.inverse(steps.T_world_node[first]) @ T_wrong_world @ steps.T_world_node[second]
    return PoseEdge.loop(first, second, T, information_of(sigma**2 * np.eye(6)))


@FEW
@given(seed=seeds)
def test_consistent_wrong_loops_are_found_by_the_chi_square_sum(seed: int) -> None:
    """Removing a single loop changes little; only the odometry residuals are large."""
    steps = walk(seed)
    loops = [shifted(steps, k, 20 + k, 2.0, 3e-4) for k in range(4)]
    solution = solve(steps.graph(*loops), PLAIN.options.kernel)
    assert solution.chi2[-4:].max() < 5
    assert retracted_loops(steps, PLAIN, loops) == {0, 1, 2, 3}


def test_wrong_loop_among_many_correct_ones_is_found_by_removal() -> None:
    """The chi-square sum is plausible; the loop distorts a section of the odometry."""
    steps = walk(4)
    loops = [*(steps.loop(k, 20 + k) for k in range(8)), shifted(steps, 12, 15, 0.15, 1e-3)]
    solution = solve(steps.graph(*loops), PLAIN.options.kernel)
    assert solution.chi2[-1] < 1
    assert solution.chi2.sum() < quantile(0.999, 6 * 9)
    assert retracted_loops(steps, PLAIN, loops) == {8}


def test_correct_loops_are_readmitted() -> None:
    steps = walk(5)
    wrong = [shifted(steps, k, 20 + k, 2.0, 0.01) for k in range(6)]
    loops = [*wrong, steps.loop(6, 26), steps.loop(7, 27)]
    solution = solve(steps.graph(*loops), PLAIN.options.kernel)
    # The first to go is a right one.
    assert solution.chi2[-8:].argmax() >= 6
    assert retracted_loops(steps, PLAIN, loops) == {0, 1, 2, 3, 4, 5}


def test_loop_that_connects_the_graph_is_kept() -> None:
    """After a gap in the odometry, one relocalisation connects the rest to the map."""
    steps = walk(3)
    graph = steps.graph(steps.loop(2, 22), steps.twin_loop(4, 14)).without([9])
    solution = PoseGraphOptimiser().optimise(graph)
    assert set(solution.retracted) < {len(graph.edges) - 2, len(graph.edges) - 1}


def test_retraction_is_deterministic() -> None:
    steps = walk(21)
    loops = [steps.twin_loop(k, 10 + k) for k in range(3)] + [steps.loop(0, 20)]
    first, second = (PoseGraphOptimiser().optimise(steps.graph(*loops)) for _ in range(2))
    assert first.retracted == second.retracted
    assert np.array_equal(first.chi2, second.chi2)
    for node, T in first.T_world_node.items():
        assert np.array_equal(T, second.T_world_node[node])
