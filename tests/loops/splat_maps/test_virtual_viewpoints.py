"""Viewpoints in a box of Gaussians: inside, before surfaces, whatever unit and axes the map has."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.slam.loops.splat_maps.viewpoints import extent, viewpoints
from toolkit.slam.loops.splat_maps.views import view_camera, virtual_keyframe
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import backend

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
HALF = np.array([2.0, 1.5, 1.2])


@pytest.fixture(scope="module")
def box() -> GaussianCloud:
    """The six walls of a room of 4 x 3 x 2.4."""
    steps = np.linspace(-1, 1, 30)
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps))
    walls = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            wall = np.full((len(u), 3), side)
            wall[:, (axis + 1) % 3], wall[:, (axis + 2) % 3] = u, v
            walls.append(wall * HALF)
    means = torch.from_numpy(np.concatenate(walls)).float()
    n = len(means)
    colours = torch.from_numpy(np.random.default_rng(0).random((n, 3))).float()
    return GaussianCloud.from_values(means, torch.full((n,), 0.1), torch.full((n,), 0.9), colours)


@pytest.fixture(scope="module")
def poses(box) -> np.ndarray:
    return viewpoints(box, CAMERA, 12)


def test_cameras_are_inside_and_see_surfaces(box, poses):
    assert len(poses) == 12
    assert (np.abs(poses[:, :3, 3]) < HALF).all()
    for T in poses:
        assert se3.is_rigid(T)
        view = virtual_keyframe(backend(), box, CAMERA, T, 0)
        assert view is not None and (view.depth_m > 0).float().mean() > 0.9
        assert view.median_depth_m > 0.5, "not before a wall"


def test_the_views_differ(poses):
    forward = poses[:, :3, 2]
    cosines = forward @ forward.T
    assert np.sort(cosines, axis=1)[:, 0].max() < 0.2, "no view is without one to another side"


def test_the_unit_of_the_map_does_not_matter(box, poses):
    small = viewpoints(box.scaled(0.125), CAMERA, 12)
    np.testing.assert_allclose(small[:, :3, 3], 0.125 * poses[:, :3, 3], atol=1e-6)
    assert extent(box.scaled(0.125)) == pytest.approx(0.125 * extent(box), rel=1e-6)


def test_stray_gaussians_do_not_matter(box):
    stray = box.select(torch.arange(20))
    far = GaussianCloud.concatenate([box, stray.scaled(500.0)])
    assert extent(far) == pytest.approx(extent(box), rel=0.1)
    assert (np.abs(viewpoints(far, CAMERA, 12)[:, :3, 3]) < HALF + 0.2).all()


def test_cameras_are_upright(box):
    up = np.array([0.0, -1.0, 0.0])
    poses = viewpoints(box, CAMERA, 12, up)
    assert (poses[:, :3, 1] @ up < 0).all(), "the image's y axis points down"
    np.testing.assert_allclose(poses[:, :3, 0] @ up, 0.0, atol=1e-9)


def test_nothing_to_see():
    assert extent(GaussianCloud.empty()) == 0.0
    assert viewpoints(GaussianCloud.empty(), CAMERA, 5).shape == (0, 4, 4)
    one = GaussianCloud.from_values(
        torch.ones(1, 3), torch.ones(1), torch.full((1,), 0.9), torch.ones(1, 3)
    )
    assert len(viewpoints(one, CAMERA, 5)) == 0


def test_a_view_of_nothing_is_no_keyframe(box):
    outside = se3.from_rotation_translation(np.eye(3), np.array([0.0, 0.0, 50.0]))
    assert virtual_keyframe(backend(), box, CAMERA, outside, 0) is None


def test_depth_of_a_rendering_is_not_measured(box, poses):
    view = virtual_keyframe(backend(), box, CAMERA, poses[0], 3)
    assert view.index == 3 and not view.measured_m.any() and view.depth_m.any()


def test_large_images_are_halved():
    assert view_camera(CAMERA) == CAMERA
    large = Camera(1000.0, 1000.0, 639.5, 479.5, 1280, 960)
    assert view_camera(large).size == (320, 240)
