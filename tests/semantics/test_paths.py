"""Paths around walls whose length is known, and what is said where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from labelled_room import T_MAP_ROOM

from toolkit.base.geometry import se3
from toolkit.io.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.measures import free_width_m, surface_distance
from toolkit.scene.graph.paths import NoPathError, PathFinder, Place, free_run_m

CELL_M = 0.05
# Nothing may rely on the map standing upright.
GRID_FROM_MAP = se3.inverse(T_MAP_ROOM)
GROUND = Ground(T_MAP_ROOM[:3, 2], float(T_MAP_ROOM[:3, 3] @ T_MAP_ROOM[:3, 2]))


def grid(door_m: float = 0.8) -> OccupancyGrid:
    """Two rooms of 4 x 4 m, joined by an opening in the wall at x = 4, y = 3 to 3 + door."""
    cells = np.full((80, 164), FREE, np.int8)
    cells[:, 80:84] = OCCUPIED
    cells[60 : 60 + round(door_m / CELL_M), 80:84] = FREE
    cells = np.pad(cells, 4, constant_values=UNKNOWN)
    return OccupancyGrid(cells, CELL_M, (-4 * CELL_M, -4 * CELL_M), GRID_FROM_MAP)


def on_map(*places: tuple[float, float]) -> np.ndarray:
    flat = np.array([(x, y, 0.0) for x, y in places])
    return se3.transform_points(T_MAP_ROOM, flat)


def place(where: OccupancyGrid, x: float, y: float) -> Place:
    return Place(f"({x:g}, {y:g})", where.mask_of(on_map((x, y))))


def test_cells_and_points_of_a_grid_belong_together():
    where = grid()
    cells = np.array([[10, 20], [50, 3]])
    np.testing.assert_array_equal(where.cells_of(where.points_of(cells)), cells)
    outside = where.cells_of(on_map((-5.0, 99.0)))
    np.testing.assert_array_equal(outside, [[where.cells.shape[0] - 1, 0]])
    inside = where.contains(on_map((0.0, 0.0), (-5.0, 1.0), (1.0, 99.0)))
    np.testing.assert_array_equal(inside, [True, False, False])


def test_a_path_leads_straight_through_the_door():
    where = grid()
    path = PathFinder(where).shortest(place(where, 1, 1), place(where, 7, 1), 0.4)
    corner = np.array([4.1, 3.2])
    direct = np.linalg.norm(corner - (1, 1)) + np.linalg.norm(corner - (7, 1))
    assert direct - 0.1 < path.length_m < 1.05 * direct
    np.testing.assert_allclose(path.points_m[[0, -1]], on_map((1, 1), (7, 1)), atol=0.05)
    assert len(path.points_m) <= 7
    assert path.width_m >= 0.4
    legs = np.linalg.norm(np.diff(path.points_m, axis=0), axis=1)
    assert path.length_m == pytest.approx(legs.sum())
    # Between two way points, a path may cross a room.
    assert np.abs(np.diff(path.cells, axis=0)).max() == 1
    np.testing.assert_allclose(where.points_of(path.cells[[0, -1]]), path.points_m[[0, -1]])


def test_wide_bodies_keep_away_from_walls():
    where = grid()
    finder = PathFinder(where)
    lengths = [
        finder.shortest(place(where, 1, 1), place(where, 7, 1), width).length_m
        for width in (0.1, 0.4, 0.7)
    ]
    assert lengths == sorted(lengths) and lengths[0] < lengths[-1]


def test_a_narrow_door_is_named_with_its_width():
    where = grid(door_m=0.42)
    with pytest.raises(NoPathError, match=r"no path 0.6 m wide from \(1, 1\) .*0\.35 m is free"):
        PathFinder(where).shortest(place(where, 1, 1), place(where, 7, 1), 0.6)
    width_m, narrowest_m = PathFinder(where).widest(place(where, 1, 1), place(where, 7, 1))
    assert width_m == pytest.approx(0.4, abs=0.06)
    flat = se3.transform_points(GRID_FROM_MAP, narrowest_m[None])[0]
    np.testing.assert_allclose(flat[:2], [4.1, 3.2], atol=0.2)


def test_a_closed_door_is_reported():
    where = grid(door_m=0.0)
    with pytest.raises(NoPathError, match="does not connect them"):
        PathFinder(where).shortest(place(where, 1, 1), place(where, 7, 1), 0.4)


def test_no_width_is_so_small_that_paths_lead_through_walls():
    where = grid(door_m=0.0)
    with pytest.raises(NoPathError, match="does not connect"):
        PathFinder(where).shortest(place(where, 1, 1), place(where, 7, 1), 1e-9)


def test_paths_end_beside_objects_and_in_their_room():
    where = grid()
    cells = where.cells.copy()
    cells[4:24, 4:44] = OCCUPIED  # a bed of 2 x 1 m in the corner
    where = OccupancyGrid(cells, CELL_M, where.origin_m, where.T_grid_map)
    footprint = np.zeros(cells.shape, bool)
    footprint[4:24, 4:44] = True
    bed = Place("bed", footprint)
    path = PathFinder(where).shortest(bed, place(where, 1, 3), 0.6)
    assert path.length_m == pytest.approx(2.0 - 0.3, abs=0.1)
    # A picture on the wall between the rooms is reached in the room that it belongs to.
    picture = np.zeros(cells.shape, bool)
    picture[24, 84:88] = True
    east = np.zeros(cells.shape, bool)
    east[:, 88:] = True
    path = PathFinder(where).shortest(Place("picture", picture, east), place(where, 7, 1), 0.4)
    assert path.length_m < 3.0


def test_a_free_spot_behind_an_object_is_no_dead_end():
    """The nearest free cell may be enclosed; the path begins at the next one that is connected."""
    where = grid()
    cells = where.cells.copy()
    cells[4:24, 4:44] = OCCUPIED
    cells[24:27, 4:44] = FREE  # a gap of 15 cm behind the bed, closed by a board
    cells[27:29, 4:44] = OCCUPIED
    cells[24:29, 44] = OCCUPIED
    where = OccupancyGrid(cells, CELL_M, where.origin_m, where.T_grid_map)
    footprint = np.zeros(cells.shape, bool)
    footprint[4:24, 4:40] = True
    path = PathFinder(where).shortest(Place("bed", footprint), place(where, 1, 3), 0.05)
    assert 1.0 < path.length_m < 3.0


def test_places_without_free_floor_are_reported():
    where = grid()
    cells = where.cells.copy()
    cells[4:50, 4:50] = UNKNOWN
    where = OccupancyGrid(cells, CELL_M, where.origin_m, where.T_grid_map)
    finder = PathFinder(where)
    with pytest.raises(NoPathError, match=r"no free floor was observed .* \(1, 1\)"):
        finder.shortest(place(where, 1, 1), place(where, 7, 1), 0.4)
    with pytest.raises(NoPathError, match=r"no floor 6 m wide is free at .* m is free there"):
        finder.shortest(place(where, 2.6, 2.6), place(where, 7, 1), 6.0)


def box(x: float, y: float, size: float) -> np.ndarray:
    """Points on the sides of a cube on the floor, in the map."""
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, size, 21)] * 2))
    sides = [np.stack([np.full_like(a, s), a, b], axis=1) for s in (0, size)]
    sides += [np.stack([a, np.full_like(a, s), b], axis=1) for s in (0, size)]
    return se3.transform_points(T_MAP_ROOM, np.concatenate(sides) + np.array([x, y, 0.0]))


def test_distances_are_between_surfaces():
    measured = surface_distance(box(0.5, 1.0, 0.5), box(2.0, 1.0, 0.5))
    assert measured.distance_m == pytest.approx(1.0)
    assert measured.centres_m == pytest.approx(1.5, abs=0.3)
    assert np.linalg.norm(np.diff(measured.nearest_m, axis=0)) == pytest.approx(1.0)


def test_the_free_width_is_what_obstacles_leave():
    where = grid()
    boxes, heights_m = (box(0.5, 1.0, 0.5), box(2.0, 1.0, 0.5)), (0.1, 1.8)
    assert free_width_m(*boxes, GROUND, where, heights_m) == pytest.approx(1.0, abs=CELL_M)
    cells = where.cells.copy()
    cells[:, 4 + 36 : 4 + 40] = OCCUPIED  # a board at x = 1.8 to 2.0
    where = OccupancyGrid(cells, CELL_M, where.origin_m, where.T_grid_map)
    assert free_width_m(*boxes, GROUND, where, heights_m) == pytest.approx(0.8, abs=CELL_M)
    assert free_run_m(where, on_map((1.82, 1.0), (1.98, 1.0))) == 0.0
    # A lamp at the ceiling is in nobody's way.
    lamp = boxes[1] + 3.0 * GROUND.up
    assert free_width_m(boxes[0], lamp, GROUND, where, heights_m) is None
