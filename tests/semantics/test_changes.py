"""Objects that were moved, are new or gone, by what both runs saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from labelled_room import T_MAP_ROOM

from toolkit.scene.graph.boxes import OrientedBox
from toolkit.scene.graph.changes import Seen, compare_objects
from toolkit.scene.query import SceneObject
from toolkit.semantics.taxonomy import Node

CLEAR, HIDDEN, FILLED = Seen(1.0, 1.0), Seen(0.0, 0.0), Seen(1.0, 0.0)


def item(name: str, x: float, y: float = 0.0, size: float = 0.5, number: int = 0):
    axis = np.linspace(0, size, 8)
    corner = np.array([x, y, 0])
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3) + corner
    centre = corner + size / 2
    box = OrientedBox(centre, np.eye(3), np.full(3, size), True)
    node = Node(name, ("things", name), 1, 0, (1,), True)
    return SceneObject(node, np.arange(len(points)), points, 1.0, box, number=number)


def kinds(found) -> set[tuple[str, str]]:
    return {(change.kind, change.name) for change in found.changes}


def always(seen: Seen):
    return lambda points_m: seen


def test_a_moved_a_new_and_a_gone_object_are_told_apart():
    before = [item("chair", 0), item("chair", 3, number=1), item("ball", 5), item("bed", 8, size=2)]
    after = [item("chair", 0.02), item("chair", 3, y=2, number=1), item("box", 6), before[3]]
    found = compare_objects(before, after, always(CLEAR), always(CLEAR))
    assert kinds(found) == {("moved", "chair"), ("gone", "ball"), ("new", "box")}
    (moved,) = (change for change in found.changes if change.kind == "moved")
    assert moved.values()["distance_m"] == pytest.approx(2.0)
    assert moved.values()["before"]["object"] == moved.values()["after"]["object"] == 1
    assert found.unchanged == 2 and not found.unknown


def test_what_nobody_looked_at_is_unknown():
    before, after = [item("ball", 5)], [item("box", 6)]
    found = compare_objects(before, after, always(HIDDEN), always(HIDDEN))
    assert not found.changes and found.unchanged == 0
    assert [o.node.name for o in found.unknown] == ["ball", "box"]


def test_a_place_with_a_surface_still_holds_its_object():
    """Its label may have changed; its surface has not."""
    found = compare_objects([item("ball", 5)], [], always(CLEAR), always(FILLED))
    assert not found.changes and found.unchanged == 1


def test_an_object_that_overlaps_with_its_old_place_is_moved():
    before, after = [item("sofa", 0, size=1.0)], [item("sofa", 0.3, size=1.0)]

    def seen(left: float):
        return lambda points_m: Seen(1.0, float((points_m[:, 0] * left > left * 0.65).mean()))

    found = compare_objects(before, after, seen(1.0), seen(-1.0))
    assert kinds(found) == {("moved", "sofa")}


def test_pieces_of_one_object_are_not_changes():
    """A bed that one run maps as two pieces is the same bed."""
    bed = item("bed", 0, size=2)
    near = bed.points_m[:, 0] < 1.0
    parts = [
        replace(
            bed, points_m=bed.points_m[m], box=replace(bed.box, size_m=bed.box.size_m / 2), number=k
        )
        for k, m in enumerate((near, ~near))
    ]
    assert not compare_objects([bed], parts, always(CLEAR), always(CLEAR)).changes


def test_sizes_must_agree_for_a_move():
    before, after = [item("box", 0, size=0.3)], [item("box", 5, size=1.5)]
    found = compare_objects(before, after, always(CLEAR), always(CLEAR))
    assert kinds(found) == {("gone", "box"), ("new", "box")}


def test_changes_follow_a_change_of_the_frame():
    found = compare_objects([item("ball", 5)], [], always(CLEAR), always(CLEAR))
    there = found.transformed(T_MAP_ROOM)
    expected = T_MAP_ROOM[:3, :3] @ found.changes[0].before.box.centre_m + T_MAP_ROOM[:3, 3]
    np.testing.assert_allclose(there.changes[0].before.box.centre_m, expected)
    assert str(there.changes[0]).startswith("gone   ball  at (")
