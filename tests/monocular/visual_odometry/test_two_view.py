"""Rotation and motion from matched points of two images."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.visual_odometry.two_view import (
    fit_rotation,
    parallax_rad,
    rays,
    relative_motion,
    triangulate,
)

CAMERA = Camera(300.0, 300.0, 160.0, 120.0, 320, 240)


def matches(T_second_first, count: int = 120, wrong: int = 0):
    """Pixels in both images, and inverse depths in the first one."""
    rng = np.random.default_rng(1)
    first = rng.uniform([10, 10], [310, 230], (count, 2))
    inverse_depth = rng.uniform(0.2, 1.0, count)
    points = rays(CAMERA, first) / inverse_depth[:, None]
    second = CAMERA.project(se3.transform_points(T_second_first, points))
    second[:wrong] = rng.uniform([10, 10], [310, 230], (wrong, 2))
    return first, second, inverse_depth


def test_a_rotation_is_found_among_wrong_matches():
    T = se3.exp([0, 0, 0, 0.05, -0.2, 0.1])
    first, second, _ = matches(T, wrong=20)
    R, error_px = fit_rotation(CAMERA, first, second)
    assert np.degrees(se3.rotation_angle_rad(R.T @ T[:3, :3])) < 0.05
    assert error_px[20:].max() < 0.5
    assert np.median(error_px[:20]) > 20.0


def test_a_translation_leaves_what_no_rotation_explains():
    first, second, _ = matches(se3.exp([0.2, 0, 0, 0.0, -0.05, 0.0]))
    _, error_px = fit_rotation(CAMERA, first, second)
    assert np.median(error_px) > 5.0


def test_the_motion_is_found_up_to_its_length():
    T = se3.exp([0.2, -0.05, 0.1, 0.02, -0.05, 0.03])
    first, second, _ = matches(T, wrong=20)
    found = relative_motion(CAMERA, first, second)
    assert found is not None
    direction = T[:3, 3] / np.linalg.norm(T[:3, 3])
    assert found.T_second_first[:3, 3] @ direction > np.cos(np.radians(1.0))
    assert found.inlier[20:].mean() > 0.95
    assert found.inlier[:20].mean() < 0.3


def test_matches_without_a_common_motion_give_none():
    rng = np.random.default_rng(2)
    first, second = rng.uniform([0, 0], [320, 240], (2, 10, 2))
    assert relative_motion(CAMERA, first, second) is None


def test_inverse_depths_follow_from_the_motion():
    T = se3.exp([0.2, -0.05, 0.1, 0.02, -0.05, 0.03])
    first, second, inverse_depth = matches(T)
    np.testing.assert_allclose(triangulate(CAMERA, T, first, second), inverse_depth, rtol=1e-9)
    each = np.tile(T, (len(first), 1, 1))
    np.testing.assert_allclose(triangulate(CAMERA, each, first, second), inverse_depth, rtol=1e-9)


def test_diverging_rays_have_no_positive_inverse_depth():
    T = se3.exp([0.2, 0, 0, 0, 0, 0])
    first, second, _ = matches(T)
    assert (triangulate(CAMERA, se3.inverse(T), first, second) < 0).all()


def test_parallax_is_what_remains_after_the_rotation():
    turned = se3.exp([0, 0, 0, 0.05, -0.2, 0.1])
    first, second, _ = matches(turned)
    assert parallax_rad(CAMERA, turned[:3, :3], first, second).max() < 1e-6
    moved = se3.exp([0.2, 0, 0, 0, 0, 0])
    first, second, inverse_depth = matches(moved)
    found = parallax_rad(CAMERA, np.eye(3), first, second)
    assert np.median(found) == pytest.approx(np.median(0.2 * inverse_depth), rel=0.2)
