"""Viewpoints for rendering without a trajectory."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering.viewpoints import Viewpoint, overview

CAMERA = Camera(fx=80.0, fy=80.0, cx=49.5, cy=39.5, width=100, height=80)


def test_positive_yaw_is_right_and_positive_pitch_is_up():
    right = Viewpoint((1.0, 2.0, 3.0), yaw_rad=math.radians(90.0)).T_map_camera
    np.testing.assert_allclose(right[:3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(right[:3, 3], [1.0, 2.0, 3.0])
    up = Viewpoint((0.0, 0.0, 0.0), pitch_rad=math.radians(90.0)).T_map_camera
    np.testing.assert_allclose(up[:3, 2], [0.0, -1.0, 0.0], atol=1e-12)


def test_pitch_is_applied_after_yaw_so_that_the_horizon_is_level():
    T = Viewpoint((0.0, 0.0, 0.0), yaw_rad=1.0, pitch_rad=0.7).T_map_camera
    # The camera's x axis has no component along the map's vertical axis.
    assert T[1, 0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("size_m", [0.1, 3.0, 500.0])
def test_overview_shows_the_whole_map_at_minimum_distance(size_m):
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 3)) * size_m + 7.0
    cloud = GaussianCloud.from_values(
        means=torch.tensor(points, dtype=torch.float32),
        radii_m=torch.full((2000,), 0.01),
        opacities=torch.full((2000,), 0.9),
        colours=torch.zeros(2000, 3),
    )
    seen = se3.transform_points(se3.inverse(overview(cloud, CAMERA)), points)
    pixels = CAMERA.project(seen)
    inside = (seen[:, 2] > 0) & (np.abs(pixels - [49.5, 39.5]) <= [50.0, 40.0]).all(axis=1)
    assert inside.mean() > 0.99
    assert np.ptp(pixels[inside], axis=0).max() > 60.0


def test_overview_of_an_empty_map_raises():
    with pytest.raises(ValueError, match="empty"):
        overview(GaussianCloud.empty(), CAMERA)
