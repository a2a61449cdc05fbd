"""The scene graph of a room of boxes while the camera turns in it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from box_room import CEILING, CRATE, CUPBOARD, FLOOR, OBJECT, SURFACE, WALL, walk
from one_submap import OneSubmap, grown, labelled_keyframe

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.scene.growing.growing import GrowingScene
from toolkit.scene.growing.objects import Fragment
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.semantics.taxonomy import Taxonomy

NAMES = {FLOOR: "floor", WALL: "wall", CEILING: "ceiling", SURFACE: "table", OBJECT: "cabinet"}
CLASSES = tuple(NAMES[k] for k in sorted(NAMES))
TAXONOMY = Taxonomy({"things": list(CLASSES)}, classes=CLASSES, name="boxes")


@pytest.fixture(scope="module")
def keyframes() -> list[Keyframe]:
    return [labelled_keyframe(view, view.frame.index) for view in walk(16)]


def new_scene() -> GrowingScene:
    return GrowingScene(TAXONOMY)


def nodes_of(content: dict, name: str) -> list[dict]:
    return [node for node in content["nodes"] if node["name"] == name]


def test_objects_have_their_places_relations_and_room(keyframes):
    atlas = OneSubmap()
    scene = grown(keyframes, new_scene(), atlas)
    scene.finish(atlas)
    content = scene.content()
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
    scene = grown(keyframes[:8], new_scene(), atlas)
    before = scene.content()
    numbers = {node["id"]: node["name"] for node in before["nodes"] if node["kind"] != "room"}
    after = grown(keyframes[8:], scene, atlas).content()
    again = {node["id"]: node["name"] for node in after["nodes"] if node["kind"] != "room"}
    kept = numbers.keys() & scene.objects.keys()
    assert len(kept) >= 3 and kept <= again.keys() <= scene.objects.keys()
    assert all(again[number] == numbers[number] for number in kept)
    ids = [node["id"] for node in after["nodes"]]
    assert len(set(ids)) == len(ids)
    assert {end for e in after["edges"] for end in (e["source"], e["target"])} <= set(ids)


def test_a_resumed_scene_continues_identically(keyframes):
    whole_atlas = OneSubmap()
    whole = grown(keyframes, new_scene(), whole_atlas)
    first_atlas = OneSubmap()
    arrays, values = grown(keyframes[:7], new_scene(), first_atlas).state()
    again = new_scene()
    again.restore(arrays, json.loads(json.dumps(values)))
    grown(keyframes[7:], again, first_atlas)
    assert again.content() == whole.content()
    (arrays, values), (expected, expected_values) = again.state(), whole.state()
    assert values == expected_values and arrays.keys() == expected.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, expected[name], err_msg=name)


def test_corrections_of_loops_move_the_graph(keyframes):
    atlas = OneSubmap()
    scene = grown(keyframes, new_scene(), atlas)
    scene.finish(atlas)
    before = scene.content()
    atlas.pose = se3.exp(np.array([1.0, -0.5, 0.3, 0.0, 0.0, 0.4]))
    scene.finish(atlas)
    after = scene.content()
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
    scene = GrowingScene(TAXONOMY, tracker)
    for keyframe in keyframes:
        tracker.update(0, [keyframe])
        grown([keyframe], scene, atlas)
    assert {one.class_name for one in tracker.objects.values()} == {"couch"}
    assert {"floor", "table", "cabinet"} <= {n["name"] for n in scene.content()["nodes"]}


def test_without_a_floor_there_is_no_graph():
    assert new_scene().content() is None


def test_fragments_add_up_voxels_in_any_order():
    rng = np.random.default_rng(0)
    fragment, expected = Fragment(), {}
    for _ in range(5):
        keys = np.unique(rng.integers(0, 50, 20))
        sums = rng.random((len(keys), 5))
        fragment.add(keys, sums)
        for key, row in zip(keys.tolist(), sums, strict=True):
            expected[key] = expected.get(key, 0.0) + row
    np.testing.assert_array_equal(fragment.keys, sorted(expected))
    np.testing.assert_allclose(
        fragment.sums_m[fragment.rows], [expected[k] for k in sorted(expected)]
    )
    assert fragment.overlap(np.array(sorted(expected))) == len(expected)
