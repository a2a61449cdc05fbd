"""Viewing volumes bounded by measured depth: analytic cases, and agreement with single pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.datasets.synthetic import tiny_room
from toolkit.geometry import open3d_bridge, se3
from toolkit.geometry.camera import Camera
from toolkit.geometry.frustum import observed_points
from toolkit.geometry.viewing_volume import ViewingVolume, inside_union
from toolkit.keyframe import Keyframe

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
WALL = ViewingVolume(CAMERA, np.full((48, 64), 2.0, np.float32))
IDENTITY = np.eye(4)[None]
tangents = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


def on_ray(u: float, v: float, z: float) -> list[float]:
    return [(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z]


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        (on_ray(30, 20, 1.0), True),
        (on_ray(30, 20, 2.09), True),  # 5 % tolerance at the surface
        (on_ray(30, 20, 2.11), False),
        (on_ray(30, 20, -1.0), False),
        (on_ray(0.1, 47.0, 2.0), True),
        (on_ray(-0.1, 20, 1.0), False),
        (on_ray(63.1, 20, 1.0), False),
        (on_ray(30, 47.1, 1.0), False),
    ],
)
def test_a_volume_ends_at_the_image_border_and_at_the_surface(point, expected):
    assert inside_union(np.array([point]), [WALL], IDENTITY).tolist() == [expected]


def test_the_volume_is_unbounded_where_depth_is_missing():
    unknown = ViewingVolume(CAMERA, np.zeros((48, 64), np.float32))
    assert inside_union(np.array([on_ray(30, 20, 9.0)]), [unknown], IDENTITY).all()


@given(tangents, tangents)
def test_the_world_frame_does_not_matter(tangent, shift):
    pose, move = se3.exp(tangent), se3.exp(shift)
    points = np.array([on_ray(u, v, z) for u in (-9, 5, 40) for v in (3, 60) for z in (1.0, 3.0)])
    expected = inside_union(points, [WALL], IDENTITY)
    moved = se3.transform_points(move @ pose, points)
    assert inside_union(moved, [WALL], (move @ pose)[None]).tolist() == expected.tolist()


def test_a_union_contains_what_any_of_its_volumes_contains():
    turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.6, 0.0]))
    poses = np.stack([np.eye(4), turned])
    small = Camera(30.0, 30.0, 15.5, 11.5, 32, 24)
    volumes = [WALL, ViewingVolume(small, np.full((24, 32), 1.0, np.float32))]
    points = np.random.default_rng(0).uniform([-2, -1, 0], [2, 1, 3], (500, 3))
    each = [inside_union(points, [v], T[None]) for v, T in zip(volumes, poses, strict=True)]
    assert each[1][~each[0]].any()
    assert (inside_union(points, volumes, poses) == each[0] | each[1]).all()


def test_no_points_and_no_volumes():
    assert inside_union(np.zeros((0, 3)), [WALL], IDENTITY).shape == (0,)
    assert not inside_union(np.ones((2, 3)), [], np.zeros((0, 4, 4))).any()


def test_the_mesh_agrees_with_the_depth_of_single_pixels():
    frames, truth = tiny_room(6, 96, 72)
    poses = np.array(truth.T_world_camera)
    first, last = frames[0], frames[-1]
    points = observed_points(last.camera, last.depth_m, 2000)
    points = se3.transform_points(poses[-1], points[np.isfinite(points).all(axis=1)])
    by_mesh = inside_union(points, [ViewingVolume(first.camera, first.depth_m)], poses[:1])
    by_pixel = Keyframe.from_frame(first, poses[0]).reaches(points)
    assert (by_mesh == by_pixel).mean() > 0.95
    assert by_mesh.mean() == pytest.approx(by_pixel.mean(), abs=0.03)


def test_without_open3d_the_error_names_the_package(monkeypatch):
    def missing():
        raise open3d_bridge.DependencyError("Open3D cannot be loaded")

    monkeypatch.setattr("toolkit.geometry.viewing_volume.open3d", missing)
    volume = ViewingVolume(CAMERA, np.full((48, 64), 2.0, np.float32))
    with pytest.raises(open3d_bridge.DependencyError, match="Open3D cannot be loaded"):
        inside_union(np.array([on_ray(30, 20, 1.0)]), [volume], IDENTITY)
