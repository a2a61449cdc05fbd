"""Room layouts: placement of furniture and smoothness of camera paths."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.datasets.synthetic_rooms.furnishing import STYLES, furnish
from toolkit.datasets.synthetic_rooms.furniture import Workshop
from toolkit.datasets.synthetic_rooms.layouts import (
    LAYOUTS,
    build_parts,
    build_scene,
    lamp_places,
    single_room,
)
from toolkit.datasets.synthetic_rooms.parts import bounds
from toolkit.datasets.synthetic_rooms.paths import hand_held_path
from toolkit.datasets.synthetic_rooms.shell import room_shell
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS, CLASS_NAMES


def _points(parts):
    return np.concatenate([p.points.reshape(-1, 3) for part in parts for p in part.patches])


def _distances_m(parts, points):
    """Distance of points to the parts' surfaces, without textures and lighting."""
    tensor = open3d().core.Tensor.from_numpy
    casting = open3d().t.geometry.RaycastingScene()
    for patch in (p for part in parts for p in part.patches):
        casting.add_triangles(
            tensor(patch.points.reshape(-1, 3).astype(np.float32)),
            tensor(patch.triangles().astype(np.uint32)),
        )
    return casting.compute_distance(tensor(points.astype(np.float32))).numpy()


def test_vocabulary_is_that_of_replica():
    assert (len(CLASS_NAMES), len(set(CLASS_NAMES))) == (101, 101)
    assert (CLASS_IDS["backpack"], CLASS_IDS["sofa"], CLASS_IDS["set-of-clothing"]) == (1, 76, 101)


@pytest.mark.parametrize("seed", range(3))
def test_one_room_has_at_least_twenty_classes(seed):
    names = {part.class_name for part in build_parts(single_room(), seed)}
    assert names <= set(CLASS_NAMES)
    assert len(names) >= 20
    assert {"wall", "floor", "ceiling", "bed", "sofa", "table", "window", "door"} <= names


@pytest.mark.parametrize("seed", range(3))
def test_furniture_is_within_the_walls(seed):
    plan = single_room().rooms[0]
    points = _points(furnish(plan, Workshop(np.random.default_rng(seed))))
    x0, y0, x1, y1 = plan.bounds_m
    assert (points >= [x0 - 1e-9, y0 - 1e-9, -1e-9]).all()
    assert (points <= [x1 + 1e-9, y1 + 1e-9, plan.height_m]).all()


def test_large_pieces_do_not_overlap():
    plan = single_room().rooms[0]
    parts = furnish(plan, Workshop(np.random.default_rng(0)))
    large = {
        name: bounds([part for part in parts if part.class_name == name])
        for name in ("bed", "sofa", "desk", "wardrobe", "shelf", "tv-stand")
    }
    names = list(large)
    for number, first in enumerate(names):
        for second in names[number + 1 :]:
            low = np.maximum(large[first][0], large[second][0])
            high = np.minimum(large[first][1], large[second][1])
            assert (low > high - 1e-6).any(), (first, second)


def test_groups_are_on_the_floor_with_their_back_to_the_wall():
    for group in {group for groups in STYLES.values() for group in groups}:
        low, high = bounds(group(Workshop(np.random.default_rng(0))))
        assert abs(low[2]) < 1e-6
        assert -0.4 < high[1] < 0.1
        assert high[2] < 2.3


@pytest.mark.parametrize("name", LAYOUTS)
def test_camera_path_is_smooth_and_keeps_its_distance(name):
    layout = LAYOUTS[name]()
    frames = 300 if name == "room" else None
    T = hand_held_path(layout.way_points, frames, 1.0, np.random.default_rng(5), layout.gait)
    motion = se3.inverse(T[:-1]) @ T[1:]
    assert np.linalg.norm(motion[:, :3, 3], axis=1).max() < 0.5 / 30 * 1.1
    assert np.degrees(se3.rotation_angle_rad(motion[:, :3, :3])).max() < 1.6
    # With steps of 2 cm, this distance also excludes paths through walls.
    assert _distances_m(build_parts(layout, 0), T[:, :3, 3]).min() > 0.4


@pytest.mark.parametrize("seed", range(4))
def test_camera_path_is_free_for_other_seeds(seed):
    layout = single_room()
    T = hand_held_path(layout.way_points, 60, 1.0, np.random.default_rng(seed))
    assert _distances_m(build_parts(layout, seed), T[:, :3, 3]).min() > 0.4


def test_path_in_one_room_returns_to_its_start():
    T = hand_held_path(single_room().way_points, 300, 1.0, np.random.default_rng(0))
    assert np.linalg.norm(T[0, :3, 3] - T[-1, :3, 3]) < 0.25
    assert T[0, :3, 2] @ T[-1, :3, 2] > 0.95
    ahead = T[:, :3, 2]
    directions = np.unique(np.round(np.arctan2(ahead[:, 1], ahead[:, 0]) / (np.pi / 6)) % 12)
    assert len(directions) == 12


def test_ring_visits_four_rooms_and_closes():
    layout = LAYOUTS["ring"]()
    T = hand_held_path(layout.way_points, 800, 1.0, np.random.default_rng(0))
    centres = np.array([plan.centre_m for plan in layout.rooms])
    nearest = np.argmin(np.linalg.norm(T[:, None, :2, 3] - centres, axis=2), axis=1)
    visits = nearest[np.concatenate([[True], np.diff(nearest) != 0])]
    assert visits.tolist() == [0, 1, 2, 3, 0]
    # The first view is revisited in the last room.
    again = T[nearest.size * 3 // 4 :]
    close = np.linalg.norm(again[:, :3, 3] - T[0, :3, 3], axis=1) < 0.4
    assert (close & (again[:, :3, 2] @ T[0, :3, 2] > 0.95)).any()


def test_shorter_path_is_the_start_of_a_longer_one():
    way = single_room().way_points
    whole = hand_held_path(way, 301, 1.0, np.random.default_rng(0))
    start = hand_held_path(way, 31, 0.1, np.random.default_rng(0))
    np.testing.assert_allclose(start, whole[:31], atol=1e-9)


def test_hall_is_four_times_rooms():
    rooms, hall = LAYOUTS["rooms"](), LAYOUTS["hall"]()
    assert len(hall.rooms) == 4 * len(rooms.rooms)
    assert len(set(hall.room_seeds)) == len(hall.rooms)
    # The path leaves rooms only through doors.
    T = hand_held_path(hall.way_points, 400, 1.0, np.random.default_rng(0))
    inside = np.zeros(len(T), bool)
    for plan in hall.rooms:
        x0, y0, x1, y1 = plan.bounds_m
        x, y = T[:, 0, 3], T[:, 1, 3]
        inside |= (x > x0 - 0.1) & (x < x1 + 0.1) & (y > y0 - 0.1) & (y < y1 + 0.1)
    assert inside.all()


def test_twin_rooms_are_identical_except_for_their_position():
    layout = LAYOUTS["twins"]()
    first, _, third, _ = layout.rooms
    assert layout.room_seeds[0] == layout.room_seeds[2] != layout.room_seeds[1]
    parts = build_parts(layout, 0)
    centres = np.array([bounds([part]).mean(axis=0)[:2] for part in parts])

    def inside(plan):
        x0, y0, x1, y1 = plan.bounds_m
        return [
            part
            for part, (x, y) in zip(parts, centres, strict=True)
            if x0 - 0.1 < x < x1 + 0.1 and y0 - 0.05 < y < y1 + 0.1
        ]

    here, there = inside(first), inside(third)
    assert [part.class_name for part in here] == [part.class_name for part in there]
    shift = np.array([third.centre_m[0] - first.centre_m[0], 0.0, 0.0])
    np.testing.assert_allclose(_points(here) + shift, _points(there), atol=1e-9)


def test_an_orbit_shows_objects_in_the_middle_from_all_sides():
    layout = LAYOUTS["orbit"]()
    T = hand_held_path(layout.way_points, 200, 1.0, np.random.default_rng(0))
    angles = np.unwrap(np.arctan2(T[:, 1, 3], T[:, 0, 3]))
    assert np.ptp(angles) > 2.0 * np.pi
    to_middle = np.array([0.0, 0.0, 0.55]) - T[:, :3, 3]
    cosine = (to_middle * T[:, :3, 2]).sum(1) / np.linalg.norm(to_middle, axis=1)
    assert np.degrees(np.arccos(cosine)).max() < 15.0
    parts = [part for part in build_parts(layout, 0) if np.abs(_middle(part)).max() < 0.5]
    names = {part.class_name for part in parts}
    assert {"table", "vase", "book", "bowl", "sculpture", "cup"} <= names


def _middle(part):
    return bounds([part]).mean(axis=0)[:2]


def test_a_still_camera_moves_less_than_a_hundredth_of_the_distance():
    T = hand_held_path(LAYOUTS["still"]().way_points, 100, 1.0, np.random.default_rng(0))
    assert np.sqrt(T[:, :3, 3].var(axis=0).sum()) < 0.015
    turned = se3.rotation_angle_rad(T[0, :3, :3].T @ T[:, :3, :3])
    assert 0.02 < turned.max() < 0.15


def test_a_long_visit_stays_away_from_walls_and_looks_everywhere():
    T = hand_held_path(LAYOUTS["long"]().way_points, None, 1.0, np.random.default_rng(0))
    assert len(T) > 9000
    assert np.abs(T[:, :2, 3]).max() < 1.0 and 1.1 < T[:, 2, 3].min() < T[:, 2, 3].max() < 1.7
    yaw = np.arctan2(T[:, 1, 2], T[:, 0, 2])
    assert np.histogram(yaw, 12, (-np.pi, np.pi))[0].min() > 100


def test_twins_of_objects_share_walls_and_textures_only():
    layout = LAYOUTS["twins-objects"]()
    first, _, third, _ = layout.rooms
    assert layout.room_seeds[0] == layout.room_seeds[2]
    shells = [room_shell(_at_origin(p), Workshop(np.random.default_rng(1))) for p in (first, third)]
    np.testing.assert_array_equal(_points(shells[0]), _points(shells[1]))
    pieces = [furnish(_at_origin(p), Workshop(np.random.default_rng(1))) for p in (first, third)]
    here, there = ({part.class_name for part in parts} for parts in pieces)
    assert {"desk", "chair"} <= here - there
    assert {"bed", "wardrobe"} <= there - here


def test_only_smaller_objects_of_the_first_room_move_before_the_return():
    layout = LAYOUTS["ring-moved"]()
    before, after = (build_parts(layout, 0, later=later) for later in (False, True))
    assert _points(before).shape == _points(build_parts(LAYOUTS["ring"](), 0)).shape
    np.testing.assert_array_equal(_points(before), _points(build_parts(LAYOUTS["ring"](), 0)))
    places = [{(part.class_name, *_centre(part)) for part in parts} for parts in (before, after)]
    x0, y0, x1, y1 = layout.rooms[0].bounds_m
    gone = places[0] - places[1]
    assert all(x0 < x < x1 and y0 < y < y1 for _, x, y, _ in gone)
    assert {"indoor-plant", "lamp"} <= {name for name, *_ in gone}
    assert not {"sofa", "wall", "floor", "picture"} & {name for name, *_ in gone}
    # What moves is found elsewhere, unless there is no place for it.
    assert {name for name, *_ in places[1] - places[0]} <= {name for name, *_ in gone}
    assert places[1] - places[0]


def test_only_the_first_room_is_dark_at_the_return():
    whole = LAYOUTS["ring-light"]()
    layout = replace(whole, rooms=whole.rooms[:2], room_seeds=whole.room_seeds[:2])
    before, after = (build_scene(layout, 0, 0.1, later=later) for later in (False, True))
    np.testing.assert_array_equal(before.vertices_m, after.vertices_m)
    middles = [plan.centre_m for plan in layout.rooms]
    first, second = (
        after.vertex_colours()[near].mean() / before.vertex_colours()[near].mean()
        for near in (np.abs(before.vertices_m[:, :2] - m).max(axis=1) < 1.9 for m in middles)
    )
    assert first < 0.85
    assert second > 0.97


def test_a_repainted_room_keeps_its_shape_but_no_colour():
    whole = LAYOUTS["ring-repainted"]()
    layout = replace(whole, rooms=whole.rooms[:2], room_seeds=whole.room_seeds[:2])
    before, after = (build_scene(layout, 0, 0.1, later=later) for later in (False, True))
    np.testing.assert_array_equal(before.vertices_m, after.vertices_m)
    np.testing.assert_array_equal(before.triangle_labels, after.triangle_labels)
    colours = [np.maximum(scene.vertex_colours(), 0.02) for scene in (before, after)]
    first, second = (
        np.log(colours[1][near] / colours[0][near]).std()
        for near in (
            np.abs(before.vertices_m[:, :2] - plan.centre_m).max(axis=1) < 1.9
            for plan in layout.rooms
        )
    )
    assert first > 0.45  # 0.3 by the light alone
    assert second < 0.05


def test_in_the_evening_objects_have_moved_and_one_lamp_is_on():
    parts = [build_parts(LAYOUTS[name](), 0, later=True) for name in ("ring-moved", "ring-evening")]
    np.testing.assert_array_equal(*map(_points, parts))
    layout = LAYOUTS["ring-evening"]()
    lamps = layout.revisit.lamps_m(layout.rooms[0], lamp_places(layout.rooms[:1]))
    assert lamps.shape == (1, 3)
    assert lamps[0, 2] < layout.rooms[0].height_m - 0.5


def _at_origin(plan):
    return replace(plan, centre_m=(0.0, 0.0))


def _centre(part):
    return tuple(np.round(bounds([part]).mean(axis=0), 6).tolist())
