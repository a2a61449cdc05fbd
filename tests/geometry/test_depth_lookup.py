"""Depths of an image at the pixels of points."""

from __future__ import annotations

import numpy as np

from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.depth_lookup import depths_at

CAMERA = Camera(fx=10.0, fy=20.0, cx=3.0, cy=2.0, width=8, height=5)


def test_every_pixel_finds_its_own_depth():
    depth_m = np.random.default_rng(0).uniform(0.5, 4.0, (5, 8)).astype(np.float32)
    points = CAMERA.unproject(depth_m).reshape(-1, 3).astype(np.float64)
    found = depths_at(points, depth_m, CAMERA)
    np.testing.assert_array_equal(found.index, np.arange(40))
    np.testing.assert_array_equal(found.row * 8 + found.column, np.arange(40))
    np.testing.assert_array_equal(found.depth_m, depth_m.ravel())
    np.testing.assert_allclose(found.z_m, depth_m.ravel(), rtol=1e-6)


def test_points_beside_the_image_and_behind_the_camera_are_left_out():
    points = np.array(
        [
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
            [0.0, 0.0, 0.0],
            [0.46, 0.0, 1.0],  # column 7.6 is beside the last one
            [0.44, 0.0, 1.0],
            [0.0, -0.13, 1.0],
            [0.0, 0.0, 0.3],
        ]
    )
    found = depths_at(points, np.ones((5, 8)), CAMERA, near_m=0.3)
    np.testing.assert_array_equal(found.index, [0, 4])
    assert len(depths_at(points[:0], np.ones((5, 8)), CAMERA).index) == 0
