"""The pose of a frame from features: what they determine, and two motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.slam.tracking.feature_pose import Observations, projected

Array = NDArray[np.float64]

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
LAST = se3.exp(np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.05]))
STEP = se3.exp(np.array([0.03, -0.01, 0.02, 0.01, 0.02, -0.01]))
UP_AND_DOWN = 1


def seen(T_map_camera: Array, depth_m: Array, noise_px: float = 0.1, seed: int = 0) -> Observations:
    """Features at these depths before LAST, as a camera sees them from another pose."""
    rng = np.random.default_rng(seed)
    px = rng.uniform([5.0, 5.0], [155.0, 115.0], (len(depth_m), 2))
    rays = np.column_stack([(px - [79.5, 59.5]) / 150.0, np.ones(len(px))])
    points = se3.transform_points(LAST, rays * depth_m[:, None])
    now = projected(CAMERA, points, T_map_camera) + noise_px * rng.standard_normal(px.shape)
    weights, certain = np.tile(np.eye(2), (len(px), 1, 1)), np.ones(len(px), bool)
    return Observations(CAMERA, points, now, now - px, weights, certain)


def depths(count: int = 120) -> Array:
    return np.random.default_rng(9).uniform(1.0, 4.0, count)


def test_the_pose_is_found_and_as_accurate_as_it_claims():
    true = LAST @ STEP
    errors = []
    for seed in range(20):
        found = seen(true, depths(), 0.3, seed).pose([LAST])
        assert found is not None and found.fits.all() and found.motions is None
        error = se3.log(se3.inverse(true) @ found.T_map_camera)
        errors.append(error @ found.information @ error / 6.0)
    assert 0.4 < np.mean(errors) < 2.5


def test_features_that_follow_something_else_are_left_out():
    true = LAST @ STEP
    observations = seen(true, depths())
    wrong = np.random.default_rng(1).random(len(observations.px)) < 0.3
    shifted = observations.px + 10.0 * wrong[:, None] * np.random.default_rng(2).normal(size=2)
    found = replace(observations, px=shifted).pose([LAST])
    assert found is not None and (found.fits == ~wrong).mean() > 0.97
    assert np.linalg.norm(se3.log(se3.inverse(true) @ found.T_map_camera)) < 0.003


def test_vertical_edges_say_nothing_about_the_motion_along_them():
    true = LAST @ STEP
    corners = seen(true, np.full(120, 2.0))
    across = np.tile(np.diag([1.0, 0.0]), (120, 1, 1))
    found = replace(corners, weights=across).pose([LAST])
    both = corners.pose([LAST])
    assert found is not None and both is not None
    variances = [
        np.linalg.inv(pose.information + 1e-3 * np.eye(6))[UP_AND_DOWN, UP_AND_DOWN]
        for pose in (found, both)
    ]
    assert variances[0] > 1000.0 * variances[1]


def test_errors_in_the_directions_of_parallel_edges_say_nothing_about_it_either():
    corners = seen(LAST @ STEP, np.full(120, 2.0))
    tilts = 0.025 * np.random.default_rng(3).standard_normal(120)
    normals = np.stack([np.cos(tilts), np.sin(tilts)], axis=1)
    found = replace(corners, weights=normals[:, :, None] * normals[:, None]).pose([LAST])
    assert found is not None
    variances = np.diag(np.linalg.inv(found.information + 1e-3 * np.eye(6)))
    assert variances[UP_AND_DOWN] > 0.1


@pytest.mark.parametrize("count", [0, 7])
def test_a_few_features_have_no_pose(count: int):
    assert seen(LAST @ STEP, depths(count)).pose([LAST]) is None


def test_features_without_a_common_motion_have_no_pose():
    observations = seen(LAST @ STEP, depths())
    scattered = np.random.default_rng(3).uniform(0.0, 120.0, observations.px.shape)
    assert replace(observations, px=scattered).pose([LAST]) is None


def test_a_moving_object_before_a_moving_camera_makes_two_motions():
    true, object_motion = LAST @ STEP, se3.exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]))
    still = seen(true, depths(160))
    moved = seen(true @ object_motion, depths(160))
    right = still.px[:, 0] > 90.0
    px = np.where(right[:, None], moved.px, still.px)
    found = replace(still, px=px).pose([LAST @ STEP, LAST])
    assert found is not None and found.motions is not None
    assert min(found.motions) > 0.25


def test_an_object_sliding_before_a_standing_camera_is_not_taken_for_a_turn():
    """Far and near plane: a turn and a step of the camera would explain both."""
    near = np.arange(200) % 2 == 0
    observations = seen(LAST, np.where(near, 1.6, 4.0), 0.02)
    slid = observations.px + 2.0 * near[:, None] * np.array([1.0, 0.0])
    flow = observations.flow + 2.0 * near[:, None] * np.array([1.0, 0.0])
    found = replace(observations, px=slid, flow=flow).pose([LAST, LAST])
    assert found is not None and found.motions is not None
    assert sum(found.motions) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_no_second_motion(seed: int):
    found = seen(LAST @ STEP, depths(), 0.8, seed).pose([LAST])
    assert found is not None and found.motions is None
