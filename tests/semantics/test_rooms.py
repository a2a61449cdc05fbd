"""Rooms drawn as rectangles of free cells: which of them a door separates."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.scene.graph import rooms
from toolkit.scene.graph.rooms import RoomMap, RoomOptions, find_rooms, free_floor

CELL_M = 0.05
FLAT = ((0, 0, 12.8, 1.9), *((4.3 * k, 2.1, 4.3 * k + 4.2, 6.1) for k in range(3)))
DOORS = tuple((4.3 * k + 1.6, 1.8, 4.3 * k + 2.6, 2.2) for k in range(3))


def canvas(*boxes: tuple[float, float, float, float]) -> np.ndarray:
    """Cells inside of any box (x0, y0, x1, y1), in metres."""
    sides = np.array(boxes).max(axis=0)[2:]
    inside = np.zeros((int(sides[1] / CELL_M) + 8, int(sides[0] / CELL_M) + 8), bool)
    for box in boxes:
        x0, y0, x1, y1 = (round(value / CELL_M) + 4 for value in box)
        inside[y0:y1, x0:x1] = True
    return inside


def cell(x: float, y: float) -> tuple[int, int]:
    return round(y / CELL_M) + 4, round(x / CELL_M) + 4


@pytest.fixture(scope="module")
def flat() -> RoomMap:
    return find_rooms(canvas(*FLAT, *DOORS), CELL_M)


def test_doors_separate_three_rooms_and_a_corridor(flat):
    assert flat.areas_m2 == pytest.approx([12.8 * 1.9, *[4.2 * 4.0] * 3], rel=0.03)
    corridor = flat.numbers[cell(6.0, 1.0)]
    assert {door.rooms for door in flat.doors} == {(corridor, k) for k in (1, 2, 3)}
    assert [door.width_m for door in flat.doors] == pytest.approx([1.0] * 3, abs=1.1 * CELL_M)
    assert len({flat.numbers[cell(2.1 + 4.3 * k, 4.0)] for k in range(3)}) == 3
    assert (flat.numbers[~canvas(*FLAT, *DOORS)] == -1).all()


@pytest.mark.parametrize(
    ("boxes", "count"),
    [
        ([(0, 0, 4, 4), (4.2, 0, 8, 4), (3.9, 1, 4.3, 3)], 1),  # an opening of two metres
        ([(0, 0, 4, 4), (4.2, 0, 8, 4), (3.9, 1, 4.3, 2)], 2),
        ([(0, 0, 4, 4), (4.2, 0, 8, 4)], 2),  # no opening
        ([(0, 0, 5, 2), (0, 0, 2, 5)], 1),  # round a corner
        ([(0, 0, 8, 1.0)], 1),  # narrower than a door everywhere
        ([(0, 0, 4, 4), (4, 1, 4.5, 1.8)], 1),  # an alcove
        ([(0, 0, 4, 4), (4.2, 0, 5.2, 1.2), (3.9, 0.2, 4.3, 1.0)], 1),  # a closet joins
        ([(0, 0, 1, 1)], 0),
    ],
)
def test_what_counts_as_a_room(boxes, count):
    assert len(find_rooms(canvas(*boxes), CELL_M)) == count


def test_floor_that_nobody_saw_does_not_separate_rooms():
    """Of a room of 4 m x 4 m, the right part of the middle is not seen."""
    inside = canvas((0, 0, 4, 1.6), (0, 2.4, 4, 4), (0, 1.6, 1.2, 2.4))
    walls = ~canvas((0, 0, 4, 4))
    assert len(find_rooms(inside, CELL_M)) == 2
    assert len(find_rooms(inside, CELL_M, walls=walls)) == 1
    jamb = walls | canvas((1.2, 1.6, 4, 2.4), (0, 0, 4, 4)) & ~inside
    assert len(find_rooms(inside, CELL_M, walls=jamb)) == 2


def test_the_width_of_doors_is_an_option():
    inside = canvas((0, 0, 4, 4), (4.2, 0, 8, 4), (3.9, 1, 4.3, 2))
    assert len(find_rooms(inside, CELL_M, RoomOptions(max_door_m=0.8))) == 1
    assert len(find_rooms(inside, CELL_M, RoomOptions(min_area_m2=20.0))) == 1


def test_a_gap_of_a_wall_is_no_door():
    rooms = ((0, 0, 4, 4), (4.2, 0, 8, 4))
    found = find_rooms(canvas(*rooms, (3.9, 1.0, 4.3, 1.2)), CELL_M)
    assert (len(found), found.doors) == (2, [])
    found = find_rooms(canvas(*rooms, (3.9, 1.0, 4.3, 1.7)), CELL_M)
    assert (len(found), len(found.doors)) == (2, 1)


def test_a_gap_behind_furniture_is_no_door():
    rooms, gap = ((0, 0, 4, 4), (4.2, 0, 8, 4)), (3.9, 1.0, 4.3, 1.8)
    inside = canvas(*rooms, gap)
    free = inside.copy()
    free[cell(3.2, 0.6)[0] : cell(3.2, 2.2)[0], cell(3.2, 0.6)[1] : cell(4.8, 0.6)[1]] = False
    found = find_rooms(inside, CELL_M, free=free)
    assert (len(found), found.doors) == (2, [])
    assert len(find_rooms(inside, CELL_M, free=inside).doors) == 1
    passed = free_floor(free, np.array([cell(4.1, 1.4)]), CELL_M)
    assert len(find_rooms(inside, CELL_M, free=passed).doors) == 1


def test_a_pillar_does_not_split_a_corridor():
    inside = canvas((0, 0, 10, 1.8))
    top, left = cell(5.0, 0.0)
    inside[top : top + 8, left : left + 8] = False  # 0.4 m of its width
    assert len(find_rooms(inside, CELL_M)) == 1


def test_rooms_survive_holes_and_rough_walls():
    inside = canvas(*FLAT, *DOORS)
    rng = np.random.default_rng(0)
    edge = inside & ~np.roll(inside, 1, axis=0) | inside & ~np.roll(inside, 1, axis=1)
    assert len(find_rooms(inside & ~(edge & (rng.random(inside.shape) < 0.5)), CELL_M)) == 4


def test_large_grids_are_reduced(flat, monkeypatch):
    inside = canvas(*FLAT, *DOORS)
    monkeypatch.setattr(rooms, "_MAX_CELLS", 8_000)
    reduced = find_rooms(inside, CELL_M)
    assert reduced.numbers.shape == inside.shape
    assert reduced.areas_m2 == pytest.approx(flat.areas_m2, rel=0.05)
    assert [door.width_m for door in reduced.doors] == pytest.approx([1.0] * 3, abs=0.2)


def test_rooms_are_numbered_by_first_visit(flat):
    stops = [(10.7, 4.0), (6.0, 1.0), (2.1, 4.0), (6.0, 1.0)]
    visits = np.array([-1, *(flat.numbers[cell(*stop)] for stop in stops)])
    numbered = flat.renumbered(visits)
    assert [int(numbered.numbers[cell(*stop)]) for stop in stops] == [0, 1, 2, 1]
    assert numbered.numbers[cell(6.4, 4.0)] == 3
    assert {door.rooms for door in numbered.doors} == {(0, 1), (1, 2), (1, 3)}
    for number, (row, column) in enumerate(numbered.centres):
        assert numbered.numbers[row, column] == number
