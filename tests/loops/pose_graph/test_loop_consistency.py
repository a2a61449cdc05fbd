"""Consistency of loops with odometry and with each other."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from walks import ODOMETRY, composed, walk

from toolkit.base.geometry import se3
from toolkit.base.pose_graph import consistency
from toolkit.base.pose_graph.clique import largest_clique
from toolkit.base.pose_graph.consistency import OdometryChain, consistent_loops, quantile
from toolkit.base.pose_graph.graph import PoseEdge, information_of

FEW = settings(deadline=None, max_examples=15)
seeds = st.integers(0, 2**16)
nodes = st.integers(0, 27)


def test_quantiles_of_the_chi_square() -> None:
    # From printed tables.
    assert quantile(0.95, 1) == pytest.approx(3.841, abs=1e-3)
    assert quantile(0.99, 6) == pytest.approx(16.812, abs=1e-3)
    assert quantile(0.999, 6) == pytest.approx(22.458, abs=1e-3)
    assert quantile(0.95, 60) == pytest.approx(79.082, abs=1e-3)
    assert quantile(1.0, 6) == np.inf


@FEW
@given(seed=seeds, first=nodes, second=nodes)
def test_section_of_the_chain_equals_its_composed_edges(seed: int, first: int, second: int) -> None:
    if first == second:
        return
    steps = walk(seed)
    chain = OdometryChain(steps.odometry)
    low, high = min(first, second), max(first, second)
    piece = composed(steps.odometry[low:high])
    expected = piece if first < second else piece.inverted()
    np.testing.assert_allclose(chain.motion(first, second), expected.T_first_second, atol=1e-10)
    np.testing.assert_allclose(
        chain.covariance(first, second), expected.covariance, rtol=1e-5, atol=1e-10
    )


def test_composed_covariance_matches_samples() -> None:
    steps = walk(4)
    edges = steps.odometry[3:9]
    edge = composed(edges)
    assert (edge.first, edge.second) == (3, 9)
    rng = np.random.default_rng(0)
    draws = []
    for _ in range(800):
        T = np.eye(4)
        for part, x in zip(edges, rng.multivariate_normal(np.zeros(6), ODOMETRY, 6), strict=True):
            T = T @ part.T_first_second @ se3.exp(x)
        draws.append(se3.log(se3.inverse(edge.T_first_second) @ T))
    L = np.linalg.cholesky(edge.information)
    spread = np.linalg.eigvalsh(L.T @ np.cov(np.array(draws).T) @ L)
    np.testing.assert_allclose(spread, 1.0, atol=0.25)


def residual_of_cycle(steps, a: PoseEdge, b: PoseEdge, noise: np.ndarray) -> np.ndarray:
    """Residual of the cycle through loops a and b with an error [6] on every edge and loop."""
    poses = [np.eye(4)]
    for edge, x in zip(steps.odometry, noise[:-2], strict=True):
        poses.append(poses[-1] @ edge.T_first_second @ se3.exp(x))
    T_a = a.T_first_second @ se3.exp(noise[-2])
    T_b = b.T_first_second @ se3.exp(noise[-1])
    there = se3.inverse(poses[a.second]) @ poses[b.second]
    back = se3.inverse(poses[b.first]) @ poses[a.first]
    return se3.log(T_a @ there @ se3.inverse(T_b) @ back)


@pytest.mark.parametrize(
    ("ends_a", "ends_b"),
    [
        ((2, 20), (3, 22)),  # the ways are apart
        ((2, 22), (5, 18)),  # one loop inside the other
        ((0, 4), (9, 15)),  # one after the other: the ways share edges
        ((0, 9), (4, 15)),
        ((9, 15), (0, 4)),
        ((3, 20), (3, 20)),  # the same twice
        ((3, 20), (20, 3)),  # and in reverse
    ],
)
def test_pair_chi2_includes_every_edge_of_the_cycle(ends_a, ends_b) -> None:
    steps = walk(6)
    chain = OdometryChain(steps.odometry)
    x = 1e-4 * np.random.default_rng(1).normal(size=6)

    def exact(ends, error) -> PoseEdge:
        T = chain.motion(*ends) @ se3.exp(error)
        return PoseEdge.loop(*ends, T, information_of(2 * ODOMETRY))

    a, b = exact(ends_a, x), exact(ends_b, np.zeros(6))
    chi2 = chain.pair_chi2(a, b)
    # The same by differences: the covariance of the cycle from each edge's own.
    if ends_b[0] > ends_b[1]:
        b = b.inverted()
    count = len(steps.odometry)
    variance = np.zeros((6, 6))
    for place in range(count + 2):
        J = np.zeros((6, 6))
        for axis in range(6):
            noise = np.zeros((count + 2, 6))
            noise[place, axis] = 1e-5
            J[:, axis] = residual_of_cycle(steps, a, b, noise)
            J[:, axis] -= residual_of_cycle(steps, a, b, -noise)
        J /= 2e-5
        own = ODOMETRY if place < count else (a if place == count else b).covariance
        variance += J @ own @ J.T
    residual = residual_of_cycle(steps, a, b, np.zeros((count + 2, 6)))
    expected = residual @ np.linalg.solve(variance, residual)
    assert chi2 == pytest.approx(expected, rel=1e-2)


def test_chi2_of_true_loops_is_chi_square_distributed() -> None:
    single, pairs = [], []
    for seed in range(80):
        steps = walk(seed)
        chain = OdometryChain(steps.odometry)
        single.append(chain.loop_chi2(steps.loop(2, 21)))
        pairs.append(chain.pair_chi2(steps.loop(1, 22), steps.loop(25, 3)))
    for sample in (single, pairs):
        # The mean of 80 draws of a chi-square of 6 has a standard deviation of 0.39.
        assert np.mean(sample) == pytest.approx(6.0, abs=1.2)
        assert np.mean(np.array(sample) > quantile(0.9, 6)) < 0.2


@FEW
@given(seed=seeds)
def test_chi2_is_invariant_to_loop_direction(seed: int) -> None:
    steps = walk(seed)
    chain = OdometryChain(steps.odometry)
    a, b = steps.loop(2, 21), steps.loop(5, 24)
    assert chain.loop_chi2(a.inverted()) == pytest.approx(chain.loop_chi2(a), rel=0.05)
    assert chain.pair_chi2(a.inverted(), b) == pytest.approx(chain.pair_chi2(a, b), rel=1e-6)
    assert chain.pair_chi2(b, a) == pytest.approx(chain.pair_chi2(a, b), rel=0.05)


@FEW
@given(seed=seeds)
def test_loops_between_identical_rooms_contradict_the_odometry(seed: int) -> None:
    steps = walk(seed)
    chain = OdometryChain(steps.odometry)
    right = [steps.loop(k, 20 + k) for k in (1, 4)]
    wrong = [steps.twin_loop(k, 10 + k) for k in range(8)]
    loops = [wrong[0], right[0], *wrong[1:], right[1]]
    found = consistent_loops(chain, loops)
    assert found.kept == (1, 9)
    # Why pairwise consistency alone is not enough: the wrong ones are the larger set.
    bound = quantile(0.999, 6)
    agree = [chain.pair_chi2(a, b) < bound for a, b in itertools.combinations(wrong, 2)]
    assert np.mean(agree) > 0.9
    assert all(found.odometry_chi2[k] > 10 * bound for k in range(10) if k not in found.kept)
    assert found.reason(1) == ""
    assert "against the odometry" in found.reason(0)


def test_loop_that_contradicts_the_others_is_rejected() -> None:
    steps = walk(8)
    chain = OdometryChain(steps.odometry)
    right = [steps.loop(k, 20 + k) for k in (2, 3, 5, 6)]
    off = steps.loop(4, 24)
    shifted = off.T_first_second @ se3.exp(np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]))
    wrong = PoseEdge.loop(4, 24, shifted, off.information)
    found = consistent_loops(chain, [*right, wrong])
    assert found.odometry_chi2[4] < found.bound
    assert found.kept == (0, 1, 2, 3)
    assert found.reason(4) == "inconsistent with 4 of 4 consistent loops"


def test_a_chain_knows_its_nodes() -> None:
    chain = OdometryChain(walk(1).odometry)
    assert 27 in chain
    assert 28 not in chain


def test_empty_set_of_loops_is_consistent() -> None:
    found = consistent_loops(OdometryChain(walk(1).odometry), [])
    assert found.kept == ()
    assert found.pair_chi2.shape == (0, 0)


def brute_force(agree: np.ndarray) -> int:
    count = len(agree)
    for size in range(count, 0, -1):
        for members in itertools.combinations(range(count), size):
            if all(agree[i, j] for i, j in itertools.combinations(members, 2)):
                return size
    return 0


@settings(deadline=None, max_examples=60)
@given(seed=seeds, count=st.integers(0, 9), share=st.floats(0.1, 0.95))
def test_largest_clique_matches_brute_force(seed: int, count: int, share: float) -> None:
    upper = np.triu(np.random.default_rng(seed).uniform(size=(count, count)) < share, 1)
    agree = upper | upper.T
    found = largest_clique(agree)
    assert found == sorted(found)
    assert all(agree[i, j] for i, j in itertools.combinations(found, 2))
    assert len(found) == brute_force(agree)
    greedy = largest_clique(agree, exact_up_to=0)
    assert all(agree[i, j] for i, j in itertools.combinations(greedy, 2))
    assert len(greedy) >= min(count, 1)


def test_tie_returns_the_lexicographically_smallest_clique() -> None:
    agree = np.zeros((6, 6), dtype=bool)
    for group in ((0, 3, 5), (1, 2, 4)):
        agree[np.ix_(group, group)] = True
    assert largest_clique(agree) == [0, 3, 5]
    assert largest_clique(agree, exact_up_to=0) == [0, 3, 5]


def test_exact_search_of_forty_contradicting_pairs_terminates() -> None:
    """There are 2^20 sets of equal size; the colouring bound must prune them."""
    agree = ~np.kron(np.eye(20, dtype=bool), np.ones((2, 2), dtype=bool))
    assert len(largest_clique(agree, exact_up_to=40)) == 20


def test_many_loops_are_searched_greedily(monkeypatch) -> None:
    steps = walk(2)
    loops = [steps.loop(k, 20 + k) for k in range(8)] + [steps.twin_loop(0, 10)]
    monkeypatch.setattr(consistency, "_EXACT_UP_TO", 3)
    assert len(consistent_loops(OdometryChain(steps.odometry), loops).kept) == 8
