"""Boxes, the ground, and areas of floor: against shapes of known size, however they lie."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from labelled_room import HEIGHT_M, LENGTH_M, WIDTH_M, labelled, room_parts, sheet

from toolkit.base.geometry import se3
from toolkit.scene.graph.boxes import Ground, floor_area_m2, oriented_box

Z_UP = Ground(np.array([0.0, 0.0, 1.0]), 0.0)
angles = st.floats(-np.pi, np.pi)
poses = st.tuples(*[st.floats(-2, 2)] * 3, angles, angles, angles).map(
    lambda v: se3.exp(np.array(v))
)


def brick(generator: np.random.Generator, size: tuple[float, float, float]) -> np.ndarray:
    """Points on and in a brick around the origin, its corners among them."""
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    return np.concatenate([corners, generator.uniform(-0.5, 0.5, (300, 3))]) * size


@given(poses, angles)
@settings(max_examples=50)
def test_a_standing_box_is_found_whatever_the_map_s_axes(T_map_room, yaw):
    points = brick(np.random.default_rng(0), (0.7, 0.4, 1.9))
    turn = se3.exp(np.array([0, 0, 0, 0, 0, yaw]))
    points_m = se3.transform_points(T_map_room @ turn, points)
    box = oriented_box(points_m, Ground(T_map_room[:3, 2], 0.0))
    assert box.upright
    np.testing.assert_allclose(box.size_m, (0.7, 0.4, 1.9), atol=1e-3)
    np.testing.assert_allclose(box.centre_m, T_map_room[:3, 3], atol=1e-3)
    np.testing.assert_allclose(box.axes[:, 2], T_map_room[:3, 2], atol=1e-9)
    np.testing.assert_allclose(box.axes.T @ box.axes, np.eye(3), atol=1e-6)
    assert np.linalg.det(box.axes) > 0


@given(poses)
@settings(max_examples=20)
def test_a_free_box_is_the_smallest(T):
    points_m = se3.transform_points(T, brick(np.random.default_rng(1), (0.7, 0.4, 1.9)))
    box = oriented_box(points_m, None)
    assert not box.upright
    np.testing.assert_allclose(box.size_m, (1.9, 0.7, 0.4), atol=1e-3)
    assert np.linalg.det(box.axes) == pytest.approx(1.0)


@given(poses, st.integers(0, 2))
@settings(max_examples=20)
def test_every_point_lies_in_its_box(T, kind):
    points_m = se3.transform_points(T, np.random.default_rng(2).normal(size=(200, 3)) * (1, 2, 3))
    box = oriented_box(points_m, None if kind == 0 else Z_UP)
    inside = np.abs((points_m - box.centre_m) @ box.axes) <= box.size_m / 2 + 1e-6
    assert inside.all()


@pytest.mark.parametrize("ground", [None, Z_UP])
@pytest.mark.parametrize(
    "points_m",
    [
        sheet((0, 0, 0), (0.5, 0.2, 0), (0, 0, 0.3)),
        np.linspace((0, 0, 0), (0.5, 0.2, 0.1), 30),
        np.full((5, 3), 0.3),
        np.array([[1.0, 2.0, 3.0]]),
    ],
    ids=["sheet", "line", "one place", "one point"],
)
def test_flat_and_tiny_things_have_boxes_too(points_m, ground):
    box = oriented_box(points_m, ground)
    assert np.isfinite(box.centre_m).all()
    diagonal = np.linalg.norm(np.ptp(points_m, axis=0))
    assert np.linalg.norm(box.size_m) == pytest.approx(diagonal, abs=1e-3)


@given(poses)
@settings(max_examples=20)
def test_the_ground_is_found_below_the_rest(T_map_room):
    points_m, labels = labelled(room_parts(), T_map_room)
    floor = labels.label == 1
    ground = Ground.below(points_m[floor], points_m[~floor])
    assert ground is not None
    np.testing.assert_allclose(ground.up, T_map_room[:3, 2], atol=1e-6)
    assert ground.height_m == pytest.approx(T_map_room[:3, 3] @ ground.up, abs=1e-6)


def test_a_floor_with_noise_and_wrong_labels_is_still_the_ground():
    generator = np.random.default_rng(0)
    parts = room_parts()
    floor = parts["floor"] + generator.normal(0, 0.01, parts["floor"].shape)
    # A seventh of it lies on one wall, up to its top.
    wall = sheet((0, 0, 0), (0, WIDTH_M, 0), (0, 0, HEIGHT_M))
    wrong = wall[generator.choice(len(wall), len(floor) // 7, replace=False)]
    ground = Ground.below(np.concatenate([floor, wrong]), parts["table"])
    assert ground is not None
    assert ground.up[2] > np.cos(np.deg2rad(0.3))


@pytest.mark.parametrize(
    "points_m",
    [
        np.zeros((2, 3)),
        np.random.default_rng(0).normal(size=(500, 3)),
        np.linspace((0, 0, 0), (3, 0, 0), 100),
        sheet((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)),
    ],
    ids=["too few", "no plane", "a line", "too small"],
)
def test_what_is_no_plane_is_no_ground(points_m):
    assert Ground.below(points_m, np.ones((5, 3))) is None


@given(angles, st.floats(0.4, 3.0), st.floats(0.3, 2.0))
@settings(max_examples=40)
def test_the_area_of_a_rectangle_is_its_area(yaw, length, width):
    turn = se3.exp(np.array([0.3, 0.2, 0, 0, 0, yaw]))
    points_m = se3.transform_points(turn, sheet((0, 0, 0.5), (length, 0, 0), (0, width, 0), 0.02))
    # Counted in cells of 5 cm: the border is uncertain by a fraction of one.
    assert floor_area_m2(points_m, Z_UP) == pytest.approx(
        length * width, abs=0.03 * 2 * (length + width)
    )


def test_areas_know_holes_and_overlaps():
    outer = sheet((0, 0, 0), (2, 0, 0), (0, 2, 0), 0.02)
    hole = (np.abs(outer[:, :2] - 1.0) < 0.5).all(axis=1)
    assert floor_area_m2(outer[~hole], Z_UP) == pytest.approx(3.0, abs=0.1)
    twice = np.concatenate([outer, outer + np.array([0, 0, 0.7])])
    assert floor_area_m2(twice, Z_UP) == pytest.approx(4.0, abs=0.1)
    apart = np.concatenate([outer, outer + np.array([5.0, 0, 0])])
    assert floor_area_m2(apart, Z_UP) == pytest.approx(8.0, abs=0.2)


def test_a_wall_covers_no_floor():
    wall = sheet((0, 0, 0), (3, 0.4, 0), (0, 0, 2))
    assert floor_area_m2(wall, Z_UP) < 0.1
    assert floor_area_m2(sheet((0, 0, 0), (LENGTH_M, 0, 0), (0, WIDTH_M, 0)), Z_UP) > 11.5
