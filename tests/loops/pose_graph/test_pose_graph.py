"""Pose graph data: validation and edge transformations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pose_graph_files import PoseGraphArrays, graph_of, poses_along
from walks import LOOP, walk

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.graph import (
    PoseEdge,
    PoseGraph,
    adjacent,
    connected_parts,
    covariance_in_frame,
    information_in_frame,
    information_of,
)

PATIENT = settings(deadline=None, max_examples=30)
seeds = st.integers(0, 2**32 - 1)


def motion(seed: int, scale: float = 1.0) -> np.ndarray:
    return se3.exp(np.random.default_rng(seed).normal(scale=scale, size=6))


def information(seed: int) -> np.ndarray:
    A = np.random.default_rng(seed).normal(size=(6, 6))
    return A @ A.T + np.eye(6)


@PATIENT
@given(seed=seeds)
def test_inverted_edge_has_the_same_chi2(seed: int) -> None:
    edge = PoseEdge(3, 5, motion(seed), information(seed))
    # Off the measurement by a little: the information is a first-order matter.
    T_first = motion(seed + 1)
    T_second = T_first @ edge.T_first_second @ motion(seed + 2, scale=1e-5)
    turned = edge.inverted()
    assert (turned.first, turned.second) == (5, 3)
    chi2 = edge.chi2(T_first, T_second)
    assert chi2 > 0
    assert turned.chi2(T_second, T_first) == pytest.approx(chi2, rel=1e-3)
    np.testing.assert_allclose(turned.inverted().information, edge.information, rtol=1e-6)


def test_edges_one_after_the_other() -> None:
    first = PoseEdge(3, 5, motion(0), information_of(1e-6 * information(0)))
    second = PoseEdge(5, 4, motion(1), information_of(1e-6 * information(1)))
    both = first.then(second)
    assert (both.first, both.second) == (3, 4)
    rng, expected = np.random.default_rng(0), first.T_first_second @ second.T_first_second
    noise = [rng.multivariate_normal(np.zeros(6), e.covariance, 4000) for e in (first, second)]
    ends = [
        se3.log(
            se3.inverse(expected)
            @ first.T_first_second
            @ se3.exp(a)
            @ second.T_first_second
            @ se3.exp(b)
        )
        for a, b in zip(*noise, strict=True)
    ]
    largest = np.abs(both.covariance).max()
    np.testing.assert_allclose(np.cov(np.transpose(ends)), both.covariance, atol=0.15 * largest)


def test_adjacent_nodes_are_one_edge_away() -> None:
    edges = [PoseEdge(a, b, np.eye(4), np.eye(6)) for a, b in ((0, 1), (1, 2), (5, 3))]
    assert adjacent({1}, edges) == {0, 1, 2}
    assert adjacent({0, 3}, edges) == {0, 1, 3, 5}
    assert adjacent({7}, edges) == {7} and adjacent(set(), edges) == set()


@PATIENT
@given(seed=seeds)
def test_information_of_a_left_perturbation(seed: int) -> None:
    T, left = motion(seed), information(seed)
    y = np.random.default_rng(seed).normal(size=6)
    x = se3.log(se3.inverse(T) @ se3.exp(1e-6 * y) @ T) / 1e-6
    right = information_in_frame(left, T)
    assert x @ right @ x == pytest.approx(y @ left @ y, rel=1e-4)


@PATIENT
@given(seed=seeds)
def test_chi2_equals_mahalanobis_norm_of_the_noise(seed: int) -> None:
    edge = PoseEdge(0, 1, motion(seed), information(seed))
    x = np.random.default_rng(seed + 1).normal(scale=0.1, size=6)
    T_world_first = motion(seed + 2)
    T_world_second = T_world_first @ edge.T_first_second @ se3.exp(x)
    assert edge.chi2(T_world_first, T_world_second) == pytest.approx(x @ edge.information @ x)
    np.testing.assert_allclose(edge.residual(T_world_first, T_world_second), x, atol=1e-9)


@PATIENT
@given(seed=seeds)
def test_covariance_of_a_pose_attached_to_a_node(seed: int) -> None:
    T_a_b, T_world_a = motion(seed), motion(seed + 1)
    x = 1e-6 * np.random.default_rng(seed).normal(size=6)
    y = se3.log(se3.inverse(T_world_a @ T_a_b) @ (T_world_a @ se3.exp(x) @ T_a_b))
    np.testing.assert_allclose(
        covariance_in_frame(np.outer(x, x), T_a_b), np.outer(y, y), rtol=1e-3, atol=1e-15
    )


def test_covariance_and_information_are_inverses() -> None:
    np.testing.assert_allclose(
        PoseEdge(0, 1, np.eye(4), information_of(LOOP)).covariance, LOOP, atol=1e-14
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"second": 0}, "connects a node to itself"),
        ({"kind": "guess"}, "kind must be"),
        ({"T_first_second": 1.1 * np.eye(4)}, "rigid transformation"),
        ({"T_first_second": np.eye(3)}, "rigid transformation"),
        ({"information": np.eye(3)}, r"finite matrix \[6, 6\]"),
        ({"information": np.full((6, 6), np.nan)}, r"finite matrix \[6, 6\]"),
        ({"information": np.eye(6) + np.eye(6, k=1)}, "symmetric"),
        ({"information": np.diag([1.0, 1, 1, 1, 1, 0])}, "positive definite"),
        ({"information": -np.eye(6)}, "positive definite"),
    ],
)
def test_invalid_edges_raise(changes: dict, message: str) -> None:
    values = {"first": 0, "second": 1, "T_first_second": np.eye(4), "information": np.eye(6)}
    with pytest.raises(ValueError, match=message):
        PoseEdge(**(values | changes))


@pytest.mark.parametrize(
    ("poses", "ends", "fixed", "message"),
    [
        ({}, [], None, "at least one node"),
        ({0: np.eye(4), 1: np.eye(4)}, [(0, 1)], 7, "fixed node 7"),
        ({0: np.eye(4), 1: 2 * np.eye(4)}, [(0, 1)], None, "pose of node 1"),
        ({-1: np.eye(4)}, [], None, "not be negative"),
        ({0: np.eye(4)}, [(0, 1)], None, "node 1, which has no pose"),
        ({0: np.eye(4), 1: np.eye(4), 2: np.eye(4)}, [(0, 1)], None, "node 2 is not connected"),
        ({0: np.eye(4), 1: np.eye(4), 2: np.eye(4)}, [(0, 1)], 2, "node 0 is not connected"),
    ],
)
def test_invalid_graphs_raise(poses: dict, ends: list, fixed: int | None, message: str) -> None:
    edges = tuple(PoseEdge(i, j, np.eye(4), np.eye(6)) for i, j in ends)
    with pytest.raises(ValueError, match=message):
        PoseGraph(poses, edges, fixed)


def test_float32_poses_are_orthonormalised() -> None:
    T = motion(3).astype(np.float32)
    edge = PoseEdge(0, 1, T, np.eye(6))
    assert se3.is_rigid(edge.T_first_second, 1e-12)
    np.testing.assert_allclose(edge.T_first_second, T, atol=1e-6)
    assert se3.is_rigid(PoseGraph({0: T}, ()).T_world_node[0], 1e-12)


def test_graph_keeps_its_input() -> None:
    T = np.eye(4)
    graph = PoseGraph({4: T, 2: T}, (PoseEdge(4, 2, T, np.eye(6)),))
    T[0, 3] = 5.0
    assert graph.nodes == [2, 4]
    assert graph.anchor == 2
    assert np.array_equal(graph.T_world_node[4], np.eye(4))
    assert str(graph) == "2 nodes, 1 edges, 0 of them loops"


def test_poses_along_uses_shortest_paths() -> None:
    step = se3.exp(np.array([1.0, 0, 0, 0, 0, 0.1]))
    edges = [PoseEdge(k, k + 1, step, np.eye(6)) for k in range(4)]
    edges.append(PoseEdge.loop(4, 0, np.eye(4), np.eye(6)))  # against its direction
    poses = poses_along(edges, 0, motion(1))
    np.testing.assert_allclose(poses[4], motion(1), atol=1e-12)
    np.testing.assert_allclose(poses[3], motion(1) @ se3.inverse(step), atol=1e-12)
    np.testing.assert_allclose(poses[2], motion(1) @ step @ step, atol=1e-12)


def test_is_connected_without_edges() -> None:
    steps = walk(2)
    graph = steps.graph(steps.loop(0, 27))
    assert graph.is_connected_without([5])
    assert not graph.is_connected_without([5, len(graph.edges) - 1])
    with pytest.raises(ValueError, match="not connected"):
        graph.without([5, len(graph.edges) - 1])


def arrays_of(graph: PoseGraph) -> PoseGraphArrays:
    return PoseGraphArrays(
        nodes=np.array(graph.nodes),
        T_world_node=np.array(list(graph.T_world_node.values())),
        edges=np.array([(edge.first, edge.second) for edge in graph.edges]),
        T_first_second=np.array([edge.T_first_second for edge in graph.edges]),
        information=np.array([edge.information for edge in graph.edges]),
        fixed=np.array([graph.anchor]),
    )


def test_graph_of_file_arrays() -> None:
    steps = walk(3)
    graph = steps.graph(steps.loop(0, 20), steps.loop(3, 23))
    again = graph_of(arrays_of(graph))
    assert (again.nodes, again.anchor) == (graph.nodes, graph.anchor)
    assert [edge.kind for edge in again.edges] == [edge.kind for edge in graph.edges]
    for name in ("T_world_node", "T_first_second", "information"):
        ours, theirs = (getattr(arrays_of(g), name) for g in (graph, again))
        assert np.array_equal(ours, theirs), name


def test_missing_poses_are_composed_along_edges() -> None:
    steps = walk(3)
    arrays = arrays_of(steps.graph(steps.loop(0, 20)))
    bare = replace(arrays, nodes=np.zeros(0, int), T_world_node=np.zeros((0, 4, 4)))
    graph = graph_of(replace(bare, fixed=np.zeros(0, int)))
    assert graph.nodes == list(range(28))
    assert [e.kind for e in graph.edges] == 27 * ["odometry"] + ["loop"]
    expected = steps.odometry[0].T_first_second @ steps.odometry[1].T_first_second
    np.testing.assert_allclose(graph.T_world_node[2], expected, atol=1e-12)


def test_connected_parts_are_ordered_by_their_lowest_nodes() -> None:
    edges = [PoseEdge(a, b, np.eye(4), np.eye(6)) for a, b in ((4, 1), (0, 3), (3, 5), (1, 6))]
    assert connected_parts(range(7), edges) == [(0, 3, 5), (1, 4, 6), (2,)]
    assert connected_parts(range(2), []) == [(0,), (1,)]
    assert connected_parts([], []) == []
