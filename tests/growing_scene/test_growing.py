"""The scene graph of a room of boxes while the camera turns in it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from box_room import CEILING, CRATE, CUPBOARD, FLOOR, OBJECT, SURFACE, WALL, walk
from one_submap import OneSubmap, grown, labelled_keyframe, new_scene

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.scene.growing.counts import PixelCounts
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.records import KeyframeMasks
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.semantics.taxonomy import Taxonomy

NAMES = {FLOOR: "floor", WALL: "wall", CEILING: "ceiling", SURFACE: "table", OBJECT: "cabinet"}
CLASSES = tuple(NAMES[k] for k in sorted(NAMES))
TAXONOMY = Taxonomy({"things": list(CLASSES)}, classes=CLASSES, name="boxes")


@pytest.fixture(scope="module")
def keyframes() -> list[Keyframe]:
    return [labelled_keyframe(view, view.frame.index) for view in walk(16)]


def nodes_of(content: dict, name: str) -> list[dict]:
    return [node for node in content["nodes"] if node["name"] == name]


def test_objects_have_their_places_relations_and_room(keyframes):
    atlas = OneSubmap()
    scene = grown(keyframes, new_scene(TAXONOMY), atlas)
    scene.finished(atlas, 1.0, [])
    content = scene.scene.content()
    assert len(nodes_of(content, "floor")) == len(nodes_of(content, "room 1")) == 1
    (floor,) = nodes_of(content, "floor")
    assert floor["kind"] == "structure" and floor["storey"] == 1
    centres = {tuple(np.round(box.mean(axis=0), 1)): box for box in (CRATE, CUPBOARD)}
    found = {}
    for node in nodes_of(content, "cabinet"):
        for place, box in centres.items():
            if np.abs(np.array(node["box"]["centre_m"]) - box.mean(axis=0)).max() < 0.35:
                found[place] = node
    assert len(found) == 2
    on = {(e["source"], e["target"]) for e in content["edges"] if e["relation"] == "on"}
    for node in found.values():
        assert (node["id"], floor["id"]) in on
        assert node["rooms"] == [1] and node["first_seen"] <= node["last_seen"]


def test_objects_keep_their_identifiers_while_the_scene_grows(keyframes):
    atlas = OneSubmap()
    scene = grown(keyframes[:8], new_scene(TAXONOMY), atlas)
    before = scene.scene.content()
    numbers = {node["id"]: node["name"] for node in before["nodes"] if node["kind"] != "room"}
    after = grown(keyframes[8:], scene, atlas).scene.content()
    again = {node["id"]: node["name"] for node in after["nodes"] if node["kind"] != "room"}
    kept = numbers.keys() & again.keys()
    assert len(kept) >= 3 and kept
    assert all(again[number] == numbers[number] for number in kept)
    ids = [node["id"] for node in after["nodes"]]
    assert len(set(ids)) == len(ids)
    assert {end for e in after["edges"] for end in (e["source"], e["target"])} <= set(ids)


def test_a_resumed_scene_continues_identically(keyframes):
    whole_atlas = OneSubmap()
    whole = grown(keyframes, new_scene(TAXONOMY), whole_atlas)
    first_atlas = OneSubmap()
    arrays, values = grown(keyframes[:7], new_scene(TAXONOMY), first_atlas).state()
    again = new_scene(TAXONOMY)
    again.restore(arrays, json.loads(json.dumps(values)))
    grown(keyframes[7:], again, first_atlas)
    assert again.scene.content() == whole.scene.content()
    (arrays, values), (expected, expected_values) = again.state(), whole.state()
    assert values == expected_values and arrays.keys() == expected.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, expected[name], err_msg=name)


def test_corrections_of_loops_move_the_graph(keyframes):
    atlas = OneSubmap()
    scene = grown(keyframes, new_scene(TAXONOMY), atlas)
    scene.finished(atlas, 1.0, [])
    before = scene.scene.content()
    atlas.pose = se3.exp(np.array([1.0, -0.5, 0.3, 0.0, 0.0, 0.4]))
    scene.finished(atlas, 1.0, [])
    after = scene.scene.content()
    assert len(before["nodes"]) == len(after["nodes"])
    centre = np.array(nodes_of(before, "table")[0]["box"]["centre_m"])
    moved = np.array(nodes_of(after, "table")[0]["box"]["centre_m"])
    np.testing.assert_allclose(moved, se3.transform_points(atlas.pose, centre[None])[0], atol=0.02)


class Foreign:
    """Masks of one class each, with names that the taxonomy lacks."""

    def masks(self, keyframe: Keyframe) -> InstanceMasks:
        masks = InstanceMasks.of_ids(keyframe.class_ids.numpy())
        return replace(masks, classes=["couch"] * len(masks))


def test_masks_of_unknown_classes_have_the_class_of_the_labels(keyframes):
    tracker, atlas = InstanceTracker(InstanceOptions(), Foreign(), NAMES), OneSubmap()
    scene = new_scene(TAXONOMY, tracker)
    for keyframe in keyframes:
        tracker.update(0, [keyframe])
        grown([keyframe], scene, atlas)
    assert {one.class_name for one in tracker.objects.values()} == {"couch"}
    assert {"floor", "table", "cabinet"} <= {n["name"] for n in scene.scene.content()["nodes"]}


def test_without_a_floor_there_is_no_graph():
    assert new_scene(TAXONOMY).scene.content() is None


def test_pixels_of_objects_add_up_over_keyframes():
    counts, ids = PixelCounts(3), np.array([[0, 1, 1], [2, 2, 0]], np.int32)
    kinds = np.array([[0, 1, 2], [0, 0, 1]])
    for objects in ([5, 6], [6, 0]):
        counts.add(KeyframeMasks.of(0, 0, np.array(objects, np.int32), ids), kinds)
    assert counts.of([5]).tolist() == [0, 1, 1] and counts.of([6]).tolist() == [2, 1, 1]
    assert counts.of([5, 6, 7]).tolist() == [2, 2, 2]
    again = PixelCounts(3)
    again.restore(counts.state())
    assert again.of([6]).tolist() == [2, 1, 1] and not again.of([]).any()
