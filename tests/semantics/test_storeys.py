"""Floors above each other are storeys; steps, ramps and stairs are not."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.rooms import RoomMap
from toolkit.scene.graph.storey_rooms import numbered_rooms
from toolkit.scene.graph.storeys import Floors, Storeys, find_storeys, lowest_floor

# Nothing may rely on the map standing upright.
T_MAP_WORLD = se3.exp(np.array([0.3, -0.2, 1.5, 2.0, 0.4, -0.3]))
UP = T_MAP_WORLD[:3, 2]
OFFSET_M = T_MAP_WORLD[:3, 3] @ UP


def level(
    x: tuple[float, float], y: tuple[float, float], height_m: float, slope: float = 0.0
) -> np.ndarray:
    """Points [N, 3] of a floor, 40 per square metre, with errors of 1 cm."""
    rng = np.random.default_rng(int(100 * height_m))
    count = int(40 * (x[1] - x[0]) * (y[1] - y[0]))
    points = rng.uniform((x[0], y[0], 0.0), (x[1], y[1], 0.0), (count, 3))
    points[:, 2] = height_m + slope * (points[:, 0] - x[0]) + rng.normal(0.0, 0.01, count)
    return points


def space_above(*heights_m: float) -> np.ndarray:
    """Points of walls and objects up to 2.5 m above floors of 8 m x 5 m."""
    rng = np.random.default_rng(0)
    return np.concatenate([rng.uniform((0, 0, h), (8, 5, h + 2.5), (1000, 3)) for h in heights_m])


WHOLE = (0.0, 8.0), (0.0, 5.0)
STAIRS = [level((8 + 0.3 * k, 8.3 + 0.3 * k), (0, 1), 0.175 * k) for k in range(16)]
HOUSES = {
    "two equal floors": ([level(*WHOLE, 0.0), level(*WHOLE, 2.8)], (0.0, 2.8)),
    "a small upper floor": ([level(*WHOLE, 0.0), level((0, 3), (0, 3), 2.8)], (0.0, 2.8)),
    "a small lower floor": ([level((0, 3), (0, 2), 0.0), level(*WHOLE, 2.8)], (0.0, 2.8)),
    "floors side by side": ([level((0, 4), (0, 5), 0.0), level((4, 8), (0, 5), 2.8)], (0.0, 2.8)),
    "large floors side by side": (
        [level((0, 10), (0, 12), 0.0), level((10, 20), (0, 12), 2.8)],
        (0.0, 2.8),
    ),
    "with stairs": ([level(*WHOLE, 0.0), *STAIRS, level(*WHOLE, 2.8)], (0.0, 2.8)),
    "three floors": ([level(*WHOLE, h) for h in (0.0, 2.8, 5.6)], (0.0, 2.8, 5.6)),
    "one floor": ([level(*WHOLE, 0.0)], (0.0,)),
    "one floor and stairs": ([level(*WHOLE, 0.0), *STAIRS], (0.0,)),
    "a platform": ([level(*WHOLE, 0.0), level((0, 3), (0, 3), 0.4)], (0.0,)),
}


@pytest.mark.parametrize("name", HOUSES)
def test_the_ground_is_the_lowest_floor(name):
    floors, heights_m = HOUSES[name]
    floor_m = se3.transform_points(T_MAP_WORLD, np.concatenate(floors))
    ground = lowest_floor(floor_m, se3.transform_points(T_MAP_WORLD, space_above(*heights_m)))
    np.testing.assert_allclose(ground.up, UP, atol=0.01)
    assert ground.height_m - OFFSET_M == pytest.approx(0.0, abs=0.03)
    found = find_storeys(floor_m @ ground.up, ground.height_m)
    np.testing.assert_allclose(np.array(found.heights_m) - OFFSET_M, heights_m, atol=0.05)


def test_cameras_show_which_side_of_floors_is_up():
    floor_m = np.concatenate([level(*WHOLE, 0.0), level(*WHOLE, 2.8)])
    for camera in ([2.0, 2.0, 1.5], [2.0, 2.0, 4.3]):
        ground = lowest_floor(floor_m, np.array([camera]))
        assert ground.up[2] > 0.99 and ground.height_m == pytest.approx(0.0, abs=0.03)


def test_ramps_and_scattered_points_are_no_storeys():
    ramp = level((0, 20), (0, 3), 0.0, slope=0.2)
    assert len(find_storeys(ramp[:, 2], 0.0)) == 1
    scattered = np.random.default_rng(0).uniform(0.0, 6.0, (3000, 3))
    assert lowest_floor(scattered, scattered + 1.0) is None


def test_storeys_are_levels_of_the_floor_but_steps_are_not():
    rng = np.random.default_rng(0)
    levels = [0.0] * 500 + [0.3] * 80 + [2.8] * 300
    storeys = find_storeys(np.array(levels) + rng.normal(0, 0.01, len(levels)), 0.0)
    np.testing.assert_allclose(storeys.heights_m, [0.0, 2.8], atol=0.02)
    assert [storeys.of(h) for h in (-0.1, 0.0, 1.5, 2.3, 2.7, 4.0)] == [0, 0, 0, 0, 1, 1]
    assert list(find_storeys(np.zeros(0), 1.5).heights_m) == [1.5]
    mezzanine = np.repeat([0.0, 1.6], [500, 300]) + rng.normal(0, 0.01, 800)
    assert len(find_storeys(mezzanine, 0.0)) == 1


def test_what_hangs_at_a_ceiling_belongs_to_the_storey_below():
    storeys = Storeys([0.0, 2.8])
    assert storeys.of(2.45, 2.55) == 0  # a lamp, or the ceiling
    assert storeys.of(2.75, 3.5) == storeys.of(2.75) == 1
    assert storeys.reached(0.0, 2.5) == range(1) and storeys.reached(2.8, 5.3) == range(1, 2)
    assert storeys.reached(0.0, 5.3) == range(2)  # the wall of a stairwell
    assert storeys.headroom_m(0) == pytest.approx(2.6) and storeys.headroom_m(1) == np.inf
    # A camera near the ceiling, and points just below the upper floor.
    assert storeys.at(np.array([-0.5, 2.4, 2.7, 4.3])).tolist() == [0, 0, 1, 1]


def test_objects_stand_on_one_storey_but_walls_and_floors_can_have_several():
    ground = Ground(np.array([0.0, 0.0, 1.0]), 0.0)
    floors = Floors(ground, Storeys([0.0, 2.8]))
    tall = level((0, 10), (0, 2), 0.0, slope=0.28)
    assert floors.of_object(tall, "object") == range(1)
    assert floors.of_object(tall, "structure") == range(1)
    assert floors.of_object(tall, "floor") == range(2)  # a ramp joins both floors
    assert floors.of_object(tall + np.array([0.0, 0.0, 2.0]), "structure") == range(2)
    sunken = level(*WHOLE, 2.5)
    assert floors.of_object(sunken, "floor") == range(1, 2)
    assert floors.of_object(sunken, "structure") == range(1)  # the ceiling below
    single = Floors(ground, Storeys([0.0]))
    assert single.of_object(np.array([[0.0, 0.0, 9.0]]), "structure") == range(1)


def test_rooms_are_numbered_by_first_visit_in_all_storeys():
    def rooms(*areas_m2: float) -> RoomMap:
        cells = np.arange(len(areas_m2), dtype=np.int32)[None]
        return RoomMap(cells, list(areas_m2), [(0, k) for k in range(len(areas_m2))], [])

    lower, upper = [0, -1, -1, 1, 0], [-1, 2, 2, -1, -1]
    found = numbered_rooms([rooms(9, 8, 2), rooms(5, 7, 6)], [np.array(lower), np.array(upper)])
    assert found.order == [(0, 0), (1, 2), (0, 1), (1, 1), (1, 0), (0, 2)]
    assert found.numbers_of(1).tolist() == [[4, 3, 1]]
