"""The parts of the geometric segmenter, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.semantics.segmenters.geometric.gravity import UpEstimator
from toolkit.semantics.segmenters.geometric.labelling import (
    OBJECT,
    WALL,
    label_cells,
    label_pixels,
)
from toolkit.semantics.segmenters.geometric.levelled import LevelledGrid
from toolkit.semantics.segmenters.geometric.levels import Level
from toolkit.semantics.segmenters.geometric.patches import planar_patches
from toolkit.semantics.segmenters.geometric.room import Room
from toolkit.semantics.segmenters.geometric.surface_grid import moved, surface_grid
from toolkit.semantics.segmenters.geometric.wall_evidence import PlaneObservation, observe
from toolkit.semantics.segmenters.geometric.walls import WallMemory

CAMERA = Camera(128.0, 128.0, 79.5, 59.5, 160, 120)


def plane_depth(normal: np.ndarray, distance_m: float, camera: Camera = CAMERA) -> np.ndarray:
    """z-depth of the plane normal . x = distance."""
    return (distance_m / (camera.rays() @ normal)).astype(np.float32)


@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(0.5, 4.0), st.sampled_from([1, 2, 4]))
def test_normals_of_a_plane_are_exact_and_face_the_camera(x, y, distance_m, block):
    normal = np.array([x, y, -1.0]) / np.linalg.norm([x, y, 1.0])
    grid = surface_grid(plane_depth(normal, -distance_m), CAMERA, columns=160 // block)
    assert grid.block == block
    assert grid.oriented.all()
    assert (grid.normals @ normal).min() > 0.9999
    np.testing.assert_allclose(grid.points @ normal, -distance_m, rtol=2e-3)


def test_normals_stay_sharp_at_a_step():
    near, far = (
        plane_depth(np.array([0.0, 0.0, -1.0]), -1.0),
        plane_depth(np.array([0.6, 0, -0.8]), -2.0),
    )
    depth = np.where(np.arange(160) < 80, near, far)
    grid = surface_grid(depth, CAMERA)
    assert (grid.normals[:, :79] @ [0.0, 0.0, -1.0]).min() > 0.999
    assert (grid.normals[:, 81:] @ [0.6, 0.0, -0.8]).min() > 0.999


def test_a_block_on_a_step_takes_the_nearer_surface():
    depth = np.full((120, 160), 3.0, np.float32)
    depth[:, 81:] = 1.0
    grid = surface_grid(depth, CAMERA, columns=80)
    np.testing.assert_allclose(grid.depth_m[:, 40], 1.0)


def test_areas_are_those_of_the_surface():
    normal = np.array([0.5, 0.0, -np.sqrt(0.75)])
    grid = surface_grid(plane_depth(normal, -2.0), CAMERA)
    corners = grid.points[[0, 0, -1, -1], [0, -1, 0, -1]]
    # The plane shows a trapezium: mean of the two upright sides times the slanted one.
    heights = np.linalg.norm(corners[:2] - corners[2:], axis=1)
    width = np.linalg.norm((corners[0] + corners[2] - corners[1] - corners[3]) / 2)
    whole = heights.mean() * width * (160 / 159) * (120 / 119)
    assert grid.areas_m2.sum() == pytest.approx(whole, rel=0.02)


def test_moving_an_image_brings_in_the_fill():
    image = np.arange(6).reshape(2, 3)
    assert moved(image, 1, -1, 9).tolist() == [[9, 9, 9], [1, 2, 9]]
    assert moved(image, 5, 0, 9).tolist() == [[9, 9, 9], [9, 9, 9]]


def test_a_plane_without_any_noise_is_found():
    grid = surface_grid(np.full((120, 160), 3.0, np.float32), CAMERA)
    (patch,) = planar_patches(grid)
    assert patch.cells.all()
    assert patch.distance_m == pytest.approx(-3.0, abs=1e-4)


def test_patches_of_a_corner_are_its_three_planes():
    # Columns: the edges of a room's corner, seen along its diagonal.
    R = np.array([[1, -1, 0], [1, 1, -2], [1, 1, 1]]) / np.sqrt([[2], [6], [3]])
    depths = [plane_depth(-R[:, axis], -2.0) for axis in range(3)]
    depth = np.min([np.where(d > 0, d, np.inf) for d in depths], axis=0)
    grid = surface_grid(depth, CAMERA)
    patches = planar_patches(grid)
    normals = np.array([p.normal for p in patches])
    for axis in range(3):
        assert (normals @ -R[:, axis]).max() > 0.9999
    assert np.sum([p.cells for p in patches], axis=0).max() == 1
    assert sum(p.cells.sum() for p in patches) > 0.95 * grid.valid.sum()


def floor_seen(level: Level, height: float, share: float = 0.3, below: float | None = None):
    """One frame: part of the cells on a level surface, some below it, the rest above."""
    heights = np.full(1000, height + 0.8)
    count = int(1000 * share)
    heights[:count] = height
    if below is not None:
        heights[-100:] = below
    level.update(heights, np.arange(1000) < count, camera_height_m=1.5)


def test_the_floor_is_followed_but_a_table_never_replaces_it():
    level = Level(1, (0.5, 2.5))
    for _ in range(20):
        floor_seen(level, 0.0)
    floor_seen(level, 0.75)
    assert level.height_m == pytest.approx(0.0)
    for _ in range(60):
        floor_seen(level, 0.03)
    assert level.height_m == pytest.approx(0.03, abs=0.01)


def test_a_lower_floor_must_be_seen_several_times():
    level = Level(1, (0.5, 2.5))
    for _ in range(10):
        floor_seen(level, 0.75)
    floor_seen(level, 0.0)
    assert level.height_m == pytest.approx(0.75)
    floor_seen(level, 0.0)
    floor_seen(level, 0.0)
    assert level.height_m == pytest.approx(0.0)


def test_what_has_something_below_it_is_no_floor():
    level = Level(1, (0.5, 2.5))
    floor_seen(level, 0.75, below=0.2)
    assert level.height_m is None


@pytest.mark.parametrize("height", [1.2, -1.2])
def test_what_is_too_near_or_too_far_is_no_floor(height):
    level = Level(1, (0.5, 2.5))
    floor_seen(level, height)
    assert level.height_m is None


def test_up_the_stairs_the_floor_is_looked_for_again():
    level = Level(1, (0.5, 2.5))
    floor_seen(level, 0.0)
    heights = np.full(100, 2.8)
    level.update(heights, np.ones(100, bool), camera_height_m=4.3)
    assert level.height_m == pytest.approx(2.8)


def test_a_ceiling_is_a_floor_upside_down():
    level = Level(-1, (0.3, 6.0))
    heights = np.array([0.0] * 50 + [2.4] * 50)
    level.update(heights, heights > 1, camera_height_m=1.5)
    assert level.height_m == pytest.approx(2.4)


def camera_pose(pitch_down_deg: float, roll_deg: float, heading_deg: float = 0.0) -> np.ndarray:
    """R_world_camera of a camera, world z up, that looks along y."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    pitch = se3.exp_so3(np.array([np.deg2rad(-pitch_down_deg), 0.0, 0.0]))
    roll = se3.exp_so3(np.array([0.0, 0.0, np.deg2rad(roll_deg)]))
    return se3.exp_so3(np.array([0.0, 0.0, np.deg2rad(heading_deg)])) @ level @ pitch @ roll


FLOOR_AND_WALLS = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])


@given(st.floats(-5, 60), st.floats(-40, 40), st.floats(0, 360))
def test_up_is_found_from_floor_and_walls_however_the_camera_is_held(pitch, roll, heading):
    estimator = UpEstimator()
    R_world_camera = camera_pose(pitch, roll, heading)
    # The map's frame is the first camera.
    assert estimator.update(FLOOR_AND_WALLS @ R_world_camera, np.full(3, 0.3), np.eye(3))
    assert estimator.direction @ (R_world_camera.T @ [0.0, 0.0, 1.0]) > np.cos(np.deg2rad(0.5))


def test_a_wrong_first_guess_is_given_up():
    estimator = UpEstimator()
    # Straight down on a desk: for one view, that is a wall seen from below.
    down = camera_pose(85.0, 0.0)
    estimator.update(FLOOR_AND_WALLS[:1], np.ones(1), down)
    assert estimator.direction[2] < 0.5
    changes = [
        estimator.update(FLOOR_AND_WALLS, np.full(3, 0.3), camera_pose(20.0, 0.0, heading))
        for heading in range(0, 60, 10)
    ]
    assert sum(changes) == 1
    np.testing.assert_allclose(estimator.direction, [0.0, 0.0, 1.0], atol=1e-2)


def test_without_planes_up_is_where_the_camera_is_held_up():
    estimator = UpEstimator()
    estimator.update(np.zeros((0, 3)), np.zeros(0), np.eye(3))
    assert estimator.direction @ [0.0, -1.0, 0.0] > 0.5


def observation(**values) -> PlaneObservation:
    """A plane of 2 x 2 m with its top out of view."""
    known = {
        "normal": np.array([1.0, 0.0, 0.0]),
        "offset_m": 0.0,
        "span_m": (-1.0, 1.0),
        "heights_m": (0.0, 2.0),
        "free_top": 0.0,
        "ceiling_top": 0.0,
        "ended_top": 0.0,
        "cut_top": 0.5,
        "cells": 1000.0,
        "cells_behind": 0.0,
    }
    return PlaneObservation(**(known | values))


@pytest.mark.parametrize(
    ("values", "wall"),
    [
        ({}, True),
        ({"free_top": 0.1, "ended_top": 0.1, "cut_top": 0.0}, False),
        ({"free_top": 0.05, "ended_top": 0.05, "cut_top": 0.5}, True),
        ({"cells_behind": 500.0}, False),
        ({"span_m": (-0.25, 0.25), "heights_m": (1.4, 1.9)}, False),
        ({"span_m": (-0.25, 0.25), "heights_m": (1.4, 1.9), "ceiling_top": 0.1}, True),
        ({"heights_m": (0.0, 2.4), "ceiling_top": 0.1, "cells_behind": 100.0}, True),
        ({"span_m": (-0.2, 0.2), "heights_m": (0.5, 0.9)}, False),
        ({"span_m": (-0.6, 0.6), "heights_m": (0.0, 0.8), "ended_top": 0.1, "cut_top": 0.0}, False),
    ],
)
def test_what_makes_a_wall(values, wall):
    memory = WallMemory()
    memory.update([observation(**values)], floor_m=0.0, ceiling_m=2.5)
    assert bool(memory.walls()) == wall


def test_a_front_once_seen_to_end_stays_furniture_when_its_top_is_out_of_view():
    memory = WallMemory()
    memory.update([observation(free_top=0.1, ended_top=0.1, cut_top=0.0)], 0.0, None)
    for _ in range(5):
        memory.update([observation(heights_m=(0.0, 1.2))], 0.0, None)
    assert not memory.walls()


def test_a_window_sill_is_not_the_top_of_its_wall():
    sill = {"heights_m": (0.0, 1.0), "free_top": 0.5, "ended_top": 0.5, "cut_top": 0.0}
    for order in ([observation(), observation(**sill)], [observation(**sill), observation()]):
        memory = WallMemory()
        for plane in order:
            memory.update([plane], 0.0, None)
        assert len(memory.walls()) == 1


def test_the_same_plane_is_one_wall_and_another_is_not():
    memory = WallMemory()
    memory.update([observation(), observation(offset_m=1.0)], 0.0, None)
    memory.update([observation(offset_m=0.03, span_m=(0.5, 3.0))], 0.0, None)
    memory.update([observation(span_m=(8.0, 9.0))], 0.0, None)
    memory.update([observation(normal=np.array([-1.0, 0.0, 0.0]))], 0.0, None)
    walls = memory.walls()
    assert [w.span_m for w in walls] == [(-1.0, 3.0), (-1.0, 1.0), (8.0, 9.0), (-1.0, 1.0)]
    assert walls[0].offset_m == pytest.approx(0.015)


def test_the_memory_of_planes_is_bounded():
    memory = WallMemory()
    for number in range(300):
        memory.update([observation(offset_m=float(number))], 0.0, None)
    assert len(memory.walls()) == 100
    assert memory.walls()[-1].offset_m == 299.0


def levelled(depth_m: np.ndarray) -> LevelledGrid:
    """A view of an upright camera."""
    up = np.array([0.0, -1.0, 0.0])
    return LevelledGrid(surface_grid(depth_m.astype(np.float32), CAMERA), np.eye(4), up)


def nearest_observation(view: LevelledGrid) -> PlaneObservation:
    patch = max(planar_patches(view.grid), key=lambda p: p.distance_m)
    found = observe(view, patch)
    assert found is not None
    return found


def test_a_window_in_a_wall_is_no_contradiction():
    depth = np.full((120, 160), 3.0)
    depth[30:80, 50:110] = 3.3
    found = nearest_observation(levelled(depth))
    assert found.cells_behind == 0
    assert found.cut_top == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(found.normal, [0.0, 0.0, -1.0], atol=1e-3)
    assert found.offset_m == pytest.approx(-3.0, abs=1e-2)


def test_a_cupboard_before_a_wall_is_backed_and_has_a_free_top():
    depth = np.full((120, 160), 3.0)
    depth[40:, 50:110] = 2.4
    found = nearest_observation(levelled(depth))
    assert found.cells_behind > 500
    assert found.free_top == pytest.approx(60 / 160, abs=0.05)
    assert found.ceiling_top == 0
    # Heights and spans by hand: pixel offsets from the middle, over focal length, times depth.
    assert found.heights_m[1] == pytest.approx((59.5 - 40) / 128 * 2.4, abs=0.05)
    left, right = (np.array([50, 109]) - 79.5) / 128 * 2.4
    assert sorted(np.abs(found.span_m)) == pytest.approx(sorted([-left, right]), abs=0.05)


def test_a_slanted_plane_is_not_upright():
    normal = np.array([0.0, -0.5, -np.sqrt(0.75)])
    view = levelled(plane_depth(normal, -2.0))
    assert all(observe(view, patch) is None for patch in planar_patches(view.grid))


def room_with(floors: int, ceilings: int) -> Room:
    """A room whose floor and ceiling, 1.2 m apart, were seen so often."""
    room = Room((0.5, 2.5))
    for level, height, count in ((room._floor, 0.0, floors), (room._ceiling, 1.2, ceilings)):
        for _ in range(count):
            level.update(np.full(100, height), np.ones(100, bool), camera_height_m=0.7)
    return room


def test_between_a_floor_and_a_ceiling_too_close_the_better_known_is_right():
    shelf_above = room_with(5, 3)
    assert shelf_above.floor_height_m == pytest.approx(0.0)
    assert shelf_above.ceiling_height_m is None
    sofa_below = room_with(3, 5)
    assert sofa_below.floor_height_m is None
    assert sofa_below.ceiling_height_m == pytest.approx(1.2)


def test_a_wall_ends_a_little_beyond_what_was_seen_of_it():
    view, room = levelled(np.full((120, 160), 4.0)), Room((0.5, 2.5))
    room.walls.update([observation(normal=np.array([0.0, 0, -1]), offset_m=-4.0)], None, None)
    labels = label_cells(view, room)
    along = np.abs(view.along(np.array([1.0, 0.0, 0.0])))
    assert (labels[along < 1.7] == WALL).all()
    assert (labels[along > 1.9] == OBJECT).all()


def test_pixels_on_a_border_take_the_side_that_their_depth_fits():
    depth = np.full((120, 160), 3.0, np.float32)
    depth[:, 81:] = 1.0  # inside a block of four pixels
    grid = surface_grid(depth, CAMERA, columns=40)
    cells = np.where(grid.depth_m > 2, WALL, OBJECT).astype(np.uint8)
    labels = label_pixels(cells, grid, depth, CAMERA)
    np.testing.assert_array_equal(labels, np.where(depth > 2, WALL, OBJECT))
