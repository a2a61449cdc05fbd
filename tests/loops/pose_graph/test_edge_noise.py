"""Edge covariances from the information of an alignment."""

from __future__ import annotations

import numpy as np
import pytest
from walks import composed

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.noise import LoopNoise, OdometryNoise, path_between

NOISE = OdometryNoise(
    scale=4.0,
    edge_m=0.1,
    edge_rad=0.2,
    per_metre_m=0.3,
    per_metre_rad=0.4,
    per_radian_m=0.5,
    per_radian_rad=0.6,
    unseen=1e6,
)


def test_covariance_contains_every_term() -> None:
    information = np.diag([1.0, 2, 4, 5, 8, 10])
    covariance = NOISE.covariance(information, metres=2.0, radians=3.0)
    floor_m2 = 0.01 + 2 * 0.09 + 3 * 0.25
    floor_rad2 = 0.04 + 2 * 0.16 + 3 * 0.36
    expected = 4.0 / np.diag(information) + np.array([floor_m2] * 3 + [floor_rad2] * 3)
    np.testing.assert_allclose(covariance, np.diag(expected), rtol=1e-9)


def test_unobserved_directions_have_the_prior_covariance() -> None:
    noise = OdometryNoise(unseen=0.5)
    corridor = np.diag([0.0, 1e8, 1e8, 1e9, 1e9, 1e9])
    sigmas = np.sqrt(np.diag(noise.covariance(corridor, 0.0, 0.0)))
    assert sigmas[0] == pytest.approx(0.5, rel=1e-2)
    assert sigmas[1:].max() < 0.01
    np.testing.assert_allclose(
        np.sqrt(np.diag(noise.covariance(np.zeros((6, 6)), 0.0, 0.0))), 0.5, rtol=1e-2
    )


def steps_of(count: int, step: np.ndarray) -> list[np.ndarray]:
    poses = [se3.exp(np.array([1.0, 2, 3, 0.3, 0.2, 0.1]))]
    for _ in range(count):
        poses.append(poses[-1] @ se3.exp(step))
    return poses


def test_drift_follows_the_path_length() -> None:
    there = steps_of(10, np.array([0.1, 0, 0, 0, 0, 0.05]))
    metres, radians = path_between([*there, *there[-2::-1]])
    assert metres == pytest.approx(2.0, rel=1e-3)
    assert radians == pytest.approx(1.0)
    assert path_between(there[:1]) == (0.0, 0.0)


def test_splitting_a_path_only_adds_the_constant_term() -> None:
    noise = OdometryNoise(edge_m=1e-6, edge_rad=1e-6, per_metre_rad=1e-9, per_radian_rad=1e-9)
    poses = steps_of(12, np.array([0.05, 0.0, 0.1, 0.0, 0.0, 0.0]))
    certain = 1e14 * np.eye(6)
    whole = noise.along(0, 12, poses, certain)
    parts = [noise.along(k, k + 3, poses[k : k + 4], certain) for k in (0, 3, 6, 9)]
    joined = composed(parts)
    np.testing.assert_allclose(joined.T_first_second, whole.T_first_second, atol=1e-12)
    np.testing.assert_allclose(joined.covariance, whole.covariance, rtol=1e-3, atol=1e-10)


def test_edge_is_the_relative_pose_of_first_and_last_frame() -> None:
    poses = steps_of(5, np.array([0.05, 0.0, 0.1, 0.0, 0.02, 0.0]))
    edge = OdometryNoise().along(3, 8, poses, 1e6 * np.eye(6))
    assert (edge.first, edge.second, edge.kind, edge.robust) == (3, 8, "odometry", False)
    np.testing.assert_allclose(poses[0] @ edge.T_first_second, poses[-1], atol=1e-12)


def test_registration_becomes_a_loop_edge() -> None:
    T = se3.exp(np.array([0.3, 0.0, 0.1, 0.0, 0.4, 0.0]))
    edge = LoopNoise(scale=2.0, edge_m=0.1, edge_rad=0.2, unseen=1e6).edge(4, 1, T, np.eye(6))
    assert (edge.first, edge.second, edge.kind, edge.robust) == (4, 1, "loop", True)
    assert np.array_equal(edge.T_first_second, T)
    np.testing.assert_allclose(edge.covariance, np.diag([2.01] * 3 + [2.04] * 3), rtol=1e-9)
