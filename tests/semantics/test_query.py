"""Asking a labelled map: what belongs to what, how many objects, where and how large."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from labelled_room import (
    CHAIR_SIZE_M,
    HEIGHT_M,
    IDS,
    LENGTH_M,
    T_MAP_ROOM,
    TABLE_SIZE_M,
    TAXONOMY,
    WIDTH_M,
    chair,
    labelled,
    labels_of,
    room_parts,
    sheet,
)

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.io.splat_labels import SplatLabels
from toolkit.scene.graph.scene import SceneReader
from toolkit.scene.query import LabelledMap, check_labels, connected
from toolkit.semantics.options import ObjectOptions

OPTIONS = ObjectOptions()


def map_of(parts: dict[str, np.ndarray], T_map_room: np.ndarray = T_MAP_ROOM) -> LabelledMap:
    points_m, labels = labelled(parts, T_map_room)
    return LabelledMap(points_m, labels, TAXONOMY)


def with_levels(labelled_map: LabelledMap, change) -> LabelledMap:
    """The map with other levels: `change` gets them and alters them in place."""
    old = labelled_map.labels
    levels = old.levels.copy()
    change(levels)
    labels = SplatLabels(old.label, levels, old.confidence)
    return LabelledMap(labelled_map.means_m, labels, TAXONOMY)


@pytest.fixture(scope="module")
def room() -> LabelledMap:
    return map_of(room_parts())


def reader(labelled_map: LabelledMap, options: ObjectOptions = OPTIONS) -> SceneReader:
    return SceneReader(labelled_map, options, np.zeros(3))


def node_index(name: str) -> int:
    return TAXONOMY.nodes.index(TAXONOMY.find(name))


def test_a_group_holds_what_its_classes_hold(room):
    members = {
        name: room.members(TAXONOMY.find(name)) for name in ("chair", "table", "furnishings")
    }
    np.testing.assert_array_equal(members["chair"] | members["table"], members["furnishings"])
    assert members["chair"].sum() == 2 * len(chair(0, 0))
    counts = dict(zip((n.name for n in TAXONOMY.nodes), room.counts(), strict=True))
    assert counts["large items"] == len(room)
    assert counts["building"] == counts["floor"] + counts["wall"]
    assert counts["small items"] == counts["sofa"] == 0


def test_names_select_and_void_is_what_has_none(room):
    ids = room.labels.label.copy()
    ids[:10] = 0
    partly = LabelledMap(room.means_m, labels_of(ids), TAXONOMY)
    assert partly.selected(["void"]).sum() == 10
    assert partly.selected(["Chair", "large items > furnishings > tables"]).sum() == (
        np.isin(ids, [IDS["chair"], IDS["table"]]).sum()
    )
    assert not partly.selected([]).any()
    with pytest.raises(FormatError, match="did you mean chair"):
        partly.selected(["chiar"])


def test_two_chairs_and_a_table_are_found_with_their_sizes(room):
    objects = room.objects(TAXONOMY.find("furnishings"), room.ground(), OPTIONS)
    assert [o.node.name for o in objects] == ["table", "chair", "chair"]
    np.testing.assert_allclose(objects[0].box.size_m, TABLE_SIZE_M, atol=1e-3)
    for found in objects[1:]:
        np.testing.assert_allclose(found.box.size_m, CHAIR_SIZE_M, atol=1e-3)
        assert found.box.upright
        assert found.confidence == pytest.approx(0.9)
    centres = se3.transform_points(
        se3.inverse(T_MAP_ROOM), np.stack([o.box.centre_m for o in objects])
    )
    expected = [(2.1, 1.4, 0.375), (1.54, 0.52, 0.45), (2.54, 0.52, 0.45)]
    for centre in expected:
        assert np.linalg.norm(centres - centre, axis=1).min() < 1e-3


def test_each_gaussian_is_of_one_object_at_most(room):
    index = np.concatenate([o.index for o in room.objects(None, room.ground(), OPTIONS)])
    assert len(index) == len(np.unique(index)) == len(room)


def test_objects_do_not_depend_on_the_order_of_gaussians(room):
    order = np.random.default_rng(0).permutation(len(room))
    mixed = LabelledMap(room.means_m[order], room.labels.select(order), TAXONOMY)
    node = TAXONOMY.find("furnishings")
    one, other = (m.objects(node, room.ground(), OPTIONS) for m in (room, mixed))
    assert {frozenset(o.index) for o in one} == {frozenset(order[o.index]) for o in other}


def test_far_specks_are_noise():
    parts = room_parts()
    specks = np.random.default_rng(0).uniform((0.2, 0.2, 1.0), (3.8, 2.8, 2.4), (40, 3))
    parts["chair"] = np.concatenate([parts["chair"], specks])
    noisy = map_of(parts)
    node = TAXONOMY.find("chair")
    assert noisy.members(node).sum() == 2 * len(chair(0, 0)) + 40
    objects = noisy.objects(node, noisy.ground(), OPTIONS)
    assert [len(o) for o in objects] == [len(chair(0, 0))] * 2


def test_options_say_what_an_object_is(room):
    node = TAXONOMY.find("chair")
    assert len(room.objects(node, None, ObjectOptions(link_m=0.7))) == 1
    assert room.objects(node, None, ObjectOptions(min_gaussians=10_000)) == []
    assert room.objects(node, None, ObjectOptions(min_confidence=0.95)) == []


def test_what_is_unsure_of_its_class_is_of_its_group(room):
    chairs, leaf = room.members(TAXONOMY.find("chair")), TAXONOMY.depth - 1

    def forget_class(levels):
        levels[chairs, leaf] = -1

    unsure = with_levels(room, forget_class)
    assert not unsure.members(TAXONOMY.find("chair")).any()
    assert unsure.objects(TAXONOMY.find("chair"), None, OPTIONS) == []
    np.testing.assert_array_equal(unsure.members(TAXONOMY.find("seating")), chairs)
    objects = unsure.objects(TAXONOMY.find("furnishings"), None, OPTIONS)
    assert [o.node.name for o in objects] == ["table", "seating", "seating"]


def test_levels_that_contradict_each_other_count_as_the_group_asked_for(room):
    chairs, leaf = room.members(TAXONOMY.find("chair")), TAXONOMY.depth - 1

    def contradict(levels):
        # A class that ends early, so that it is its own node at deeper levels.
        levels[np.ix_(chairs, [1, leaf])] = node_index("cup")

    strange = with_levels(room, contradict)
    objects = strange.objects(TAXONOMY.find("seating"), None, OPTIONS)
    assert [o.node.name for o in objects] == ["seating", "seating"]
    assert strange.members(TAXONOMY.find("cup")).sum() == chairs.sum()
    tree = reader(strange).tree()["tree"]
    small = next(node for node in tree if node["name"] == "small items")
    assert (small["gaussians"], small["confidence"]) == (0, None)
    assert small["children"][0]["gaussians"] == chairs.sum()


def test_the_ground_comes_from_the_floor_or_from_the_ceiling(room):
    up = T_MAP_ROOM[:3, 2]
    ground = room.ground()
    np.testing.assert_allclose(ground.up, up, atol=1e-6)
    assert ground.height_m == pytest.approx(T_MAP_ROOM[:3, 3] @ up, abs=1e-6)
    parts = room_parts()
    del parts["floor"]
    assert map_of(parts).ground() is None
    assert map_of(parts).ground(["wall", "nothing"]) is None
    assert room.ground(["building"]) is None


def test_without_a_floor_boxes_are_free_and_areas_unknown():
    parts = {"chair": chair(0, 0), "table": room_parts()["table"]}
    answer = reader(map_of(parts)).answer("table")
    assert answer["floor_area_m2"] is None
    assert answer["objects"][0]["box"]["upright"] is False
    size_m = answer["objects"][0]["box"]["size_m"]
    np.testing.assert_allclose(size_m, sorted(TABLE_SIZE_M, reverse=True), atol=2e-3)


def test_an_answer_contains_counts_areas_and_distances(room):
    viewpoint_m = se3.transform_points(T_MAP_ROOM, np.array([[2.1, 1.4, 1.75]]))[0]
    values = SceneReader(room, OPTIONS, viewpoint_m).answer("tables")
    assert values["path"] == ["large items", "furnishings", "tables"]
    assert values["gaussians"] == len(room_parts()["table"])
    assert values["confidence"] == pytest.approx(0.9, abs=1e-4)
    # The board's Gaussian right below lies within half a spacing of 4 cm.
    assert values["objects"][0]["distance_m"] == pytest.approx(1.0, abs=0.001)
    assert values["floor_area_m2"] == pytest.approx(1.2 * 0.8, abs=0.1)
    assert values["objects"][0]["is_class"] is True
    assert reader(room).answer("sofa") == {
        "path": ["large items", "furnishings", "seating", "sofa"],
        "metric": True,
        "gaussians": 0,
        "confidence": None,
        "floor_area_m2": 0.0,
        "objects": [],
    }


def test_a_summary_is_json_that_describes_the_room(room):
    summary = json.loads(json.dumps(reader(room).summary(), allow_nan=False))
    assert summary["taxonomy"]["digest"] == TAXONOMY.digest
    assert summary["gaussians"] == len(room)
    assert summary["unlabelled"] == 0
    np.testing.assert_allclose(
        summary["room"]["box"]["size_m"], (LENGTH_M, WIDTH_M, HEIGHT_M), atol=1e-3
    )
    assert summary["room"]["floor_area_m2"] == pytest.approx(LENGTH_M * WIDTH_M, rel=0.03)
    names = [found["name"] for found in summary["objects"]]
    assert sorted(names) == ["chair", "chair", "floor", "table", "wall"]
    assert [found["id"] for found in summary["objects"]] == list(range(5))
    (large,) = summary["tree"]
    assert [node["name"] for node in large["children"]] == ["building", "furnishings"]


def test_a_map_without_a_room_has_none():
    summary = reader(map_of({"chair": chair(0, 0)})).summary()
    assert summary["room"] is None
    assert summary["up"] is None


def test_a_map_where_nothing_has_a_label_is_empty_but_no_failure(room):
    nothing = LabelledMap(room.means_m, labels_of(np.zeros(len(room), int)), TAXONOMY)
    summary = reader(nothing).summary()
    assert summary["objects"] == summary["tree"] == []
    assert summary["unlabelled"] == len(room)


@pytest.mark.parametrize(
    ("label", "levels", "message"),
    [
        (1, [0, 1, 2], "3 levels, taxonomy 'room' has 4"),
        (7, [0, 1, 2, 2], "class 7, taxonomy 'room' has classes 1 to 6"),
        (-1, [0, 1, 2, 2], "class -1"),
        (1, [0, 1, 2, 99], "node 99 at level 3"),
        (1, [1, 1, 2, 2], "node 1 at level 0"),
        (1, [0, -2, 2, 2], "node -2 at level 1"),
    ],
)
def test_labels_of_another_tree_are_refused(label, levels, message):
    labels = SplatLabels(
        np.array([label], np.int32), np.array([levels], np.int32), np.ones(1, np.float32)
    )
    with pytest.raises(FormatError, match=message):
        check_labels(labels, TAXONOMY)


@pytest.mark.parametrize("confidence", [-0.1, 1.5, np.nan])
def test_confidences_that_are_none_are_refused(confidence):
    with pytest.raises(FormatError, match="outside 0 to 1"):
        check_labels(labels_of(np.ones(3, int), confidence), TAXONOMY)


def test_as_many_labels_as_gaussians():
    with pytest.raises(ValueError, match=r"\[1, 3\]"):
        LabelledMap(np.zeros((2, 3)), labels_of(np.ones(1, int)), TAXONOMY)


@given(st.integers(0, 10_000), st.integers(1, 4))
@settings(max_examples=25)
def test_pieces_that_lie_apart_are_separated(seed, count):
    generator = np.random.default_rng(seed)
    pieces = [
        sheet((i * 1.0, 0, 0), (0.3 + 0.2 * generator.uniform(), 0, 0), (0, 0.4, 0.2))
        for i in range(count)
    ]
    order = generator.permutation(sum(map(len, pieces)))
    points_m = np.concatenate(pieces)[order]
    found = connected(points_m, 0.08)
    assert [len(piece) for piece in found] == sorted(map(len, pieces), reverse=True)
    for piece in found:
        assert len(np.unique(points_m[piece, 0].round())) == 1


def test_a_fragment_that_hardly_touches_an_object_belongs_to_it():
    parts = [chair(0.0, 0.0), chair(2.0, 0.0)]
    top = sheet((0.1, 0.0, CHAIR_SIZE_M[2] + 0.08), (0.2, 0, 0), (0, 0.2, 0))

    def sizes(*chairs: np.ndarray) -> list[int]:
        found = map_of({"chair": np.concatenate(chairs)}).objects(None, None, OPTIONS)
        return [len(item) for item in found]

    assert sizes(*parts, top) == [len(parts[0]) + len(top), len(parts[1])]
    far = top + np.array([0.0, 0.0, 0.5])
    assert sizes(*parts, far) == [len(parts[0]), len(parts[1]), len(top)]


def test_an_object_beside_one_of_similar_size_is_no_fragment():
    near = chair(CHAIR_SIZE_M[0] + 0.12, 0.0)
    parts = {"chair": np.concatenate([chair(0.0, 0.0), near])}
    options = replace(OPTIONS, link_m=0.05)
    assert len(map_of(parts).objects(None, None, options)) == 2


def test_nothing_has_no_pieces():
    assert connected(np.empty((0, 3)), 0.05) == []
    assert connected(np.zeros((1, 3)), 0.05) == []


def test_large_ellipsoids_are_connected_through_their_axes():
    # Two boards 40 cm apart, each of ten flat ellipsoids whose centres are 9 cm apart.
    row = np.stack([0.09 * np.arange(10), np.zeros(10), np.zeros(10)], axis=1)
    points_m = np.concatenate([row, row + np.array([0.0, 0.4, 0.0])])
    axes_m = np.tile(np.diag([0.045, 0.04, 0.002]), (20, 1, 1))
    assert connected(points_m, 0.06) == []
    boards = connected(points_m, 0.06, axes_m)
    assert [board.tolist() for board in boards] == [list(range(10)), list(range(10, 20))]


def touching_chairs(instances: list[int] | None) -> LabelledMap:
    """A floor and two chairs that touch; with the instances of floor, first and second chair."""
    parts = [chair(1.0, 1.0), chair(1.0 + CHAIR_SIZE_M[0], 1.0)]
    means_m, labels = labelled({"floor": sheet((0, 0, 0), (3, 0, 0), (0, 3, 0))})
    for part in parts:
        points_m, more = labelled({"chair": part})
        means_m = np.concatenate([means_m, points_m])
        columns = (
            np.concatenate([getattr(labels, name), getattr(more, name)])
            for name in ("label", "levels", "confidence")
        )
        labels = SplatLabels(*columns)
    if instances is not None:
        counts = [len(means_m) - sum(map(len, parts)), *map(len, parts)]
        labels = replace(labels, instances=np.repeat(instances, counts).astype(np.int32))
    return LabelledMap(means_m, labels, TAXONOMY)


@pytest.mark.parametrize(
    ("instances", "chairs"),
    [(None, [0]), ([3, 1, 2], [1, 2]), ([0, 1, 1], [1]), ([3, 0, 2], [2, 0])],
)
def test_chairs_that_touch_are_apart_where_the_map_has_instances(instances, chairs):
    map_ = touching_chairs(instances)
    found = map_.objects(TAXONOMY.find("chair"), None, ObjectOptions())
    assert sorted(one.instance for one in found) == sorted(chairs)
    assert sum(map(len, found)) == 2 * len(chair(0, 0))


def test_an_instance_has_the_class_of_most_of_its_gaussians():
    map_ = touching_chairs([1, 1, 1])
    assert [one.node.name for one in map_.objects(None, None, ObjectOptions())] == ["floor"]
    assert map_.objects(TAXONOMY.find("chair"), None, ObjectOptions()) == []


def test_unsure_gaussians_do_not_belong_to_an_object():
    map_ = touching_chairs([3, 1, 2])
    confidence = map_.labels.confidence.copy()
    second = map_.labels.instances == 2
    confidence[second] = 0.2
    unsure = replace(map_, labels=replace(map_.labels, confidence=confidence))
    options = ObjectOptions(min_confidence=0.5)
    assert [one.instance for one in unsure.objects(TAXONOMY.find("chair"), None, options)] == [1]
