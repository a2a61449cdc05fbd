"""Points inside a camera's frustum: agreement with projection."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import open3d_bridge
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.frustum import inside_frustum

CAMERA = Camera(50.0, 48.0, 31.5, 22.0, 64, 48)


def on_ray(u: float, v: float, z: float) -> list[float]:
    return [(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z]


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        (on_ray(30, 20, 1.0), True),
        (on_ray(30, 20, 0.04), False),
        (on_ray(30, 20, -1.0), False),
        (on_ray(0.1, 46.9, 2.0), True),
        (on_ray(-0.1, 20, 1.0), False),
        (on_ray(63.1, 20, 1.0), False),
        (on_ray(30, 47.1, 1.0), False),
    ],
)
def test_a_frustum_ends_at_the_centres_of_the_outer_pixels(point, expected):
    assert inside_frustum(CAMERA, np.array([point])).tolist() == [expected]


def test_it_agrees_with_projection():
    points = np.random.default_rng(0).uniform([-4, -4, -1], [4, 4, 6], (20_000, 3))
    ahead = points[:, 2] > 0.05
    u, v = CAMERA.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0])).T
    expected = ahead & (u >= 0) & (u <= 63) & (v >= 0) & (v <= 47)
    assert 0.1 < expected.mean() < 0.5
    assert (inside_frustum(CAMERA, points) == expected).all()


def test_points_of_the_pixel_grid_are_inside():
    """Rays through regular points are most likely to meet edges of the mesh."""
    v, u = np.mgrid[0.5:47:1, 0.5:63:1]
    points = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)])
    assert inside_frustum(CAMERA, 2.0 * points.reshape(3, -1).T).all()


def test_no_points():
    assert inside_frustum(CAMERA, np.zeros((0, 3))).shape == (0,)


def test_without_open3d_the_error_names_the_package(monkeypatch):
    def missing():
        raise open3d_bridge.DependencyError("Open3D cannot be loaded")

    monkeypatch.setattr("toolkit.base.geometry.frustum.open3d", missing)
    with pytest.raises(open3d_bridge.DependencyError, match="Open3D cannot be loaded"):
        inside_frustum(CAMERA, np.array([on_ray(30, 20, 1.0)]))
