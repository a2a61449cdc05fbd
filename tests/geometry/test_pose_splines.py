"""Camera paths pass through their poses and move smoothly."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.pose_splines import pose_spline, thinned


def some_poses(count: int, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    steps = generator.uniform(-0.4, 0.4, (count, 6))
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3.exp(step))
    return np.array(poses)


def test_the_path_passes_through_all_poses():
    poses = some_poses(6)
    path = pose_spline(poses, 4000)
    np.testing.assert_allclose(path[[0, -1]], poses[[0, -1]], atol=1e-9)
    for pose in poses:
        assert np.abs(path - pose).max(axis=(1, 2)).min() < 2e-3
    assert all(se3.is_rigid(T, 1e-9) for T in path[::100])


def test_the_velocity_is_continuous():
    positions = pose_spline(some_poses(6), 4000)[:, :3, 3]
    velocity = np.diff(positions, axis=0)
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    assert change.max() < 0.02 * np.linalg.norm(velocity, axis=1).max()


def test_equal_poses_are_one_and_a_single_pose_stands_still():
    poses = some_poses(3)
    twice = poses[[0, 0, 1, 1, 2]]
    np.testing.assert_allclose(pose_spline(twice, 50), pose_spline(poses, 50))
    np.testing.assert_allclose(pose_spline(poses[:1], 5), np.repeat(poses[:1], 5, axis=0))


@pytest.mark.parametrize("min_step", [0.05, 0.3, 100.0])
def test_thinning_keeps_both_ends(min_step):
    poses = some_poses(30, seed=1)
    kept = thinned(poses, min_step)
    np.testing.assert_array_equal(kept[0], poses[0])
    np.testing.assert_array_equal(kept[-1], poses[-1])
    assert len(kept) <= 30 and (min_step < 100 or len(kept) == 2)
