"""Numbers of the objects in synthetic rooms."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.datasets.synthetic_rooms import furnishing, furniture
from toolkit.datasets.synthetic_rooms.furniture import Workshop
from toolkit.datasets.synthetic_rooms.layouts import LAYOUTS, build_parts
from toolkit.datasets.synthetic_rooms.parts import Part


def objects_of(parts: list[Part], class_name: str) -> list[int]:
    return sorted({part.object_id for part in parts if part.class_name == class_name})


@pytest.fixture
def shop() -> Workshop:
    return Workshop(np.random.default_rng(0))


def test_touching_parts_of_a_class_are_one_object(shop):
    parts = furniture.bed(shop)
    assert len(objects_of(parts, "bed")) == 1  # frame and mattress
    assert len(objects_of(parts, "pillow")) == 2
    assert len({part.object_id for part in parts}) == 5


def test_pieces_that_touch_are_two_objects(shop):
    stacked = furnishing._boxes_group(shop)
    assert len(objects_of(stacked, "box")) == 2


def test_every_part_of_every_room_has_an_object_of_its_class():
    parts = build_parts(LAYOUTS["twins"](), seed=0)
    classes: dict[int, set[str]] = {}
    for part in parts:
        classes.setdefault(part.object_id, set()).add(part.class_name)
    assert 0 not in classes
    assert all(len(names) == 1 for names in classes.values())
    # Two rooms and the corridor share no floor.
    assert len(objects_of(parts, "floor")) == len(LAYOUTS["twins"]().rooms)


def test_objects_that_move_keep_their_numbers():
    layout = LAYOUTS["ring-moved"]()
    before, after = (build_parts(layout, seed=0, later=later) for later in (False, True))
    names = [{p.object_id: p.class_name for p in parts} for parts in (before, after)]
    shared = names[0].keys() & names[1].keys()
    assert len(shared) > 0.9 * len(names[0])
    assert all(names[0][number] == names[1][number] for number in shared)
