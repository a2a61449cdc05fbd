"""The object to which a Gaussian at a place belongs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.viewer.picking import object_at
from toolkit.viewer.scene import ShownObject

CHAIR, SOFA = ("furniture", "seat", "chair"), ("furniture", "seat", "sofa")


def box(number: int, low: float, high: float, path: tuple[str, ...] = CHAIR) -> ShownObject:
    """A cube from one corner to the other."""
    corners_m = np.array([[(low, high)[i >> a & 1] for a in range(3)] for i in range(8)])
    return ShownObject(number, f"object {number}", "room 1", corners_m, path=path)


def grown(number: int, low: float, high: float, path: tuple[str, ...] = CHAIR) -> ShownObject:
    """A cube whose voxels lie on one of its diagonals only."""
    steps = np.arange(low, high + 0.001, 0.05)
    return replace(box(number, low, high, path), voxels_m=np.stack([steps] * 3, axis=1))


def at(*position: float) -> np.ndarray:
    return np.array(position, np.float32)


def test_it_is_the_one_with_the_nearest_voxel():
    chairs = [grown(3, 0.0, 1.0), grown(5, 0.92, 2.0)]
    assert object_at(chairs, at(0.5, 0.52, 0.5), CHAIR) == 3
    assert object_at(chairs, at(1.4, 1.42, 1.4), CHAIR) == 5
    assert [object_at(chairs, at(x, x, x), CHAIR) for x in (0.95, 0.97, 1.0, 1.02)] == [3, 5, 3, 5]
    assert object_at(chairs, at(0.8, 0.2, 0.5), CHAIR) is None, "in the box, far from all voxels"
    assert object_at(chairs, at(0.5, 0.5, 9.0), CHAIR) is None
    assert object_at([], at(0.5, 0.5, 0.5), CHAIR) is None


@pytest.mark.parametrize(
    ("path", "number"),
    [(CHAIR, 3), (SOFA, 5), (CHAIR[:2], 5), ((), 5), (("structure",), None), ((*CHAIR, "x"), None)],
)
def test_its_class_agrees_with_what_is_known_of_the_gaussian(path, number):
    """The sofa is nearer than the chair."""
    found = [grown(3, 0.0, 1.0, CHAIR), grown(5, 0.03, 1.03, SOFA)]
    assert object_at(found, at(0.53, 0.53, 0.53), path) == number


def test_boxes_are_used_where_voxels_are_unknown():
    found = [box(1, 0.0, 2.0), box(2, 0.5, 1.0), box(3, 0.6, 0.9, SOFA)]
    assert object_at(found, at(0.7, 0.7, 0.7), CHAIR) == 2, "the smallest one of its class"
    assert object_at(found, at(1.5, 1.5, 1.5), CHAIR) == 1
    assert object_at(found, at(2.05, 1.0, 1.0), CHAIR) == 1, "a little outside"
    assert object_at(found, at(2.2, 1.0, 1.0), CHAIR) is None
    assert object_at(found, at(0.7, 0.7, 0.7), ()) is None, "what is under a table is not the table"


def test_turned_and_flat_boxes_contain_what_lies_in_them():
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    flat = box(1, 0.0, 1.0).corners_m * (1.0, 1.0, 0.0) @ turn.T
    picture = ShownObject(1, "picture 1", "", flat, path=CHAIR)
    inside = turn @ (0.9, 0.1, 0.05)
    assert object_at([picture], inside, CHAIR) == 1
    assert object_at([picture], inside + at(0.0, 0.0, 0.2), CHAIR) is None
    assert object_at([picture], turn @ (0.9, -0.2, 0.0), CHAIR) is None
