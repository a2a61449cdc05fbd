"""The scene graph of a house of two storeys while the camera moves."""

from __future__ import annotations

import json

import numpy as np
import pytest
from box_room import CEILING, FLOOR, OBJECT, SURFACE, WALL, walk
from labelled_room import chair, table
from one_submap import OneSubmap, grown, labelled_keyframe, new_scene
from two_storeys import AREAS_M2, STOREY_M, VISITED, points_of

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.relations import Relation
from toolkit.scene.graph.scene_relations import SceneRelations
from toolkit.scene.graph.storeys import Floors, Storeys
from toolkit.scene.growing.listener import SceneListener
from toolkit.scene.growing.rooms import GrowingBuilding
from toolkit.semantics.taxonomy import Taxonomy

NAMES = {FLOOR: "floor", WALL: "wall", CEILING: "ceiling", SURFACE: "table", OBJECT: "cabinet"}
CLASSES = tuple(NAMES[k] for k in sorted(NAMES))
TAXONOMY = Taxonomy({"things": list(CLASSES)}, classes=CLASSES, name="boxes")
# The upper room is turned by a quarter and beside the lower one: the walls of both cross.
T_UPPER = se3.from_rotation_translation(
    se3.exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.array([0.8, 0.3, STOREY_M])
)


def keyframes() -> list[Keyframe]:
    """Views of the lower room, then of the upper one."""
    views = [(T, view) for T in (np.eye(4), T_UPPER) for view in walk(16)]
    return [labelled_keyframe(view, index, T) for index, (T, view) in enumerate(views)]


def finished(views: list[Keyframe], scene: SceneListener, atlas: OneSubmap) -> dict:
    """The graph of a scene after these keyframes."""
    grown(views, scene, atlas)
    scene.finished(atlas, 1.0, [])
    return scene.content()


@pytest.fixture(scope="module")
def content() -> dict:
    return finished(keyframes(), new_scene(TAXONOMY), OneSubmap())


def test_each_storey_has_its_room_and_objects(content):
    assert content["graph"]["floor_height_m"] == pytest.approx(0.0, abs=0.03)
    assert content["graph"]["storeys_m"] == pytest.approx([0.0, STOREY_M], abs=0.05)
    nodes = content["nodes"]
    rooms = [node for node in nodes if node["kind"] == "room"]
    assert [room["storey"] for room in rooms] == [1, 2]
    # Each is 5 m x 4 m; the lower one has the same area without an upper one.
    assert rooms[0]["area_m2"] == pytest.approx(rooms[1]["area_m2"], rel=0.1)
    lower = finished(keyframes()[:16], new_scene(TAXONOMY), OneSubmap())
    (alone,) = [node for node in lower["nodes"] if node["kind"] == "room"]
    assert rooms[0]["area_m2"] == pytest.approx(alone["area_m2"], rel=0.05)
    for name in ("floor", "table"):
        found = [node for node in nodes if node["name"] == name]
        assert {(node["storey"], *node["rooms"]) for node in found} == {(1, 1), (2, 2)}
    kinds = [node["kind"] for node in nodes if node["kind"] in ("storey", "building")]
    assert kinds == ["storey", "storey", "building"]


def test_relations_of_the_upper_storey_are_those_of_the_lower_one(content):
    nodes = {node["id"]: node for node in content["nodes"]}
    found = ([], [])
    for edge in content["edges"]:
        ends = nodes[edge["source"]], nodes[edge["target"]]
        if all("box" in end for end in ends):
            assert ends[0]["storey"] == ends[1]["storey"], edge
            named = (ends[0]["name"], edge["relation"], ends[1]["name"])
            found[ends[0]["storey"] - 1].append(named)
    assert sorted(found[0]) == sorted(found[1]) and ("cabinet", "on", "floor") in found[0]


def test_objects_face_those_of_their_storey():
    up = np.array([0.0, 0.0, STOREY_M])
    # The lower table is nearer to the front of the chair, seen from above.
    points = {1: table(0.5, 0.8), 2: chair(0.9, 0.0) + up, 3: table(0.5, 1.6) + up}
    floors = Floors(Ground(np.array([0.0, 0.0, 1.0]), 0.0), Storeys([0.0, STOREY_M]))
    live = SceneRelations(points.__getitem__)
    for number in points:
        live.changed(number, "object")
    live.update(floors, np.zeros((0, 3)))
    assert live.relations() == [Relation(2, 3, "facing")]


def test_a_resumed_scene_has_the_same_storeys(content):
    views, atlas = keyframes(), OneSubmap()
    first = new_scene(TAXONOMY)
    for keyframe in views[:28]:
        atlas.keyframes.append(keyframe)
        first.frame_added(atlas, 1.0)
    arrays, values = first.state()
    again = new_scene(TAXONOMY)
    again.restore(arrays, json.loads(json.dumps(values)))
    assert again.state()[1] == values and len(values["storeys_m"]) == 2
    assert finished(views[28:], again, atlas) == content


def test_rooms_of_storeys_do_not_mix_and_are_numbered_by_first_visit():
    parts = points_of(0), points_of(1)
    walls = np.concatenate([part["wall"] for part in parts])
    ground, tables = (np.concatenate([part[k] for part in parts]) for k in ("floor", "table"))
    floors = Floors(Ground(np.array([0.0, 0.0, 1.0]), 0.0), Storeys([0.0, STOREY_M]))
    fans = [
        np.array([x, y, storey * STOREY_M + 1.5]) + np.zeros((4, 24, 3)) for x, y, storey in VISITED
    ]
    # From the upper storey down to places beside the house.
    down = np.array([4.0, 5.0, STOREY_M + 1.5]) + np.zeros((4, 24, 3))
    down[1:] = np.stack([np.linspace(0, 8, 24), np.full(24, -3.0), np.zeros(24)], axis=1)
    building = GrowingBuilding(floors, walls, ground, tables, [*fans, down])
    assert [storey for storey, _ in building.rooms.order] == [0, 1, 1, 0]
    rooms = [building.describe(k) for k in range(4)]
    assert [room["area_m2"] for room in rooms] == pytest.approx(AREAS_M2, rel=0.15)
    assert [room["doors"][0]["to_room"] for room in rooms] == [4, 3, 2, 1]
    heights_m = [room["centre_m"][2] for room in rooms]
    np.testing.assert_allclose(heights_m, [0.0, STOREY_M, STOREY_M, 0.0])
    for storey, (part, room) in enumerate(zip(parts, (3, 1), strict=True)):
        assert building.rooms_of(part["table"], range(storey, storey + 1)) == {room: 1.0}
