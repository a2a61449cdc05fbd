"""Similarity graphs: drift in scale is distributed over the sequence."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.similarity import SimilarityEdge, solve_similarities


def circle(count: int = 24) -> np.ndarray:
    """Poses [N, 4, 4] of a camera that walks in a circle and looks ahead."""
    step = se3.exp([0.0, 0.0, 0.5, 0.0, 2 * np.pi / count, 0.0])
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def drifting(truth: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """The same steps, each `factor` times as long as the one before, and the units."""
    units = factor ** np.arange(len(truth))
    poses = [truth[0]]
    for n in range(len(truth) - 1):
        step = se3.inverse(truth[n]) @ truth[n + 1]
        step[:3, 3] *= units[n]
        poses.append(poses[-1] @ step)
    return np.array(poses), units


def sequence(poses: np.ndarray, log_scale_sigma: float = 0.03) -> list[SimilarityEdge]:
    return [
        SimilarityEdge(
            n, n + 1, se3.inverse(poses[n]) @ poses[n + 1], 1.0, 0.005, 0.01, log_scale_sigma
        )
        for n in range(len(poses) - 1)
    ]


def revisit(truth: np.ndarray, units: np.ndarray, first: int, second: int) -> SimilarityEdge:
    T = se3.inverse(truth[first]) @ truth[second]
    T[:3, 3] *= units[first]
    ratio = units[first] / units[second]
    return SimilarityEdge(first, second, T, ratio, 0.001, 0.002, 0.002, robust=True)


def test_a_loop_removes_the_drift_in_scale():
    truth = circle()
    poses, units = drifting(truth, 1.02)
    loop = revisit(truth, units, 0, len(truth) - 1)
    solution = solve_similarities(poses, [*sequence(poses), loop])
    found = np.array(solution.T_world_node)
    before = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    after = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    assert before > 0.5
    assert after < 0.05
    np.testing.assert_allclose(solution.scale, 1.0 / units, rtol=0.02)
    assert solution.error_after < solution.error_before


def test_a_wrong_loop_among_right_ones_has_little_effect():
    truth = circle()
    poses, units = drifting(truth, 1.02)
    edges = [*sequence(poses), *(revisit(truth, units, n, 23 - n) for n in range(4))]
    wrong = revisit(truth, units, 5, 17)
    T = wrong.T_first_second @ se3.exp([0.4, 0.0, 0.0, 0.0, 0.3, 0.0])
    edges.append(SimilarityEdge(5, 17, T, 1.0, 0.02, 0.05, 0.05, robust=True))
    found = np.array(solve_similarities(poses, edges).T_world_node)
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.15


def test_consistent_edges_change_nothing():
    truth = circle(6)
    solution = solve_similarities(truth, sequence(truth))
    np.testing.assert_allclose(np.array(solution.T_world_node), truth, atol=1e-9)
    assert solution.error_after == pytest.approx(0.0, abs=1e-12)
