"""The truth of the benchmark of relations."""

from __future__ import annotations

from benchmarks.semantics.relation_truth import TrueRelations

FLOOR, SOFA, CUSHION, TABLE, VASE, SHELF, BOOKS = 3, 18, 19, 22, 23, 39, 40


def test_truth_of_a_room_follows_from_its_geometry():
    truth = TrueRelations("room", 0, {FLOOR, SOFA, CUSHION, TABLE, VASE, SHELF, BOOKS})
    names = [truth.objects[k].name for k in (SOFA, CUSHION, TABLE, VASE, SHELF, BOOKS)]
    assert names == ["sofa", "cushion", "table", "vase", "shelf", "book"]
    assert {r for r in truth.relations if r[1] != "next to"} == {
        (SOFA, "on", FLOOR),
        (CUSHION, "on", SOFA),
        (TABLE, "on", FLOOR),
        (VASE, "on", TABLE),
        (SHELF, "on", FLOOR),
        (BOOKS, "in", SHELF),
        (SOFA, "facing", TABLE),
    }


def test_doors_of_a_ring_connect_neighbouring_rooms():
    truth = TrueRelations("ring", 0, set())
    assert {tuple(sorted(rooms)) for rooms, _, _ in truth.doors} == {(0, 1), (1, 2), (2, 3), (0, 3)}
