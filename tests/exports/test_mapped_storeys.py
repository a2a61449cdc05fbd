"""Rooms, graph, paths and plans of a map of two storeys."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from layout_run import T_MAP_WORLD, TAXONOMY
from two_storeys import AREAS_M2, DOOR_M, STOREY_M, VISITED, house_run

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.exports.building import views_on
from toolkit.exports.mapped_scene import MappedScene, map_scene
from toolkit.exports.options import ObjectGraphOptions, PlanOptions
from toolkit.exports.plans import export_floor_plan
from toolkit.exports.scene_graph import scene_graph
from toolkit.exports.selection import select
from toolkit.io.images import read_rgb
from toolkit.io.length_names import METRES
from toolkit.runs.maps.visibility import KeyframeViews
from toolkit.runs.report_pictures import report_floor_plan
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.paths import NoPathError
from toolkit.scene.graph.storeys import Floors, Storeys
from toolkit.tools.viewer.shown_objects import graph_objects

OPTIONS = ObjectGraphOptions(link_m=0.2, min_gaussians=20)


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    return house_run(tmp_path_factory.mktemp("house") / "run")


@pytest.fixture(scope="module")
def scene(house) -> MappedScene:
    return map_scene(select(house), OPTIONS)


def numbers(scene: MappedScene, name: str) -> list[int]:
    """The objects of a class, the lowest first."""
    found = [k for k, one in enumerate(scene.objects) if one.node.name == name]
    return sorted(found, key=lambda k: scene.objects[k].box.centre_m @ scene.ground.up)


def test_rooms_of_storeys_do_not_mix_and_are_numbered_by_first_visit(scene):
    rooms = scene.building.rooms
    assert [storey for storey, _ in rooms.order] == [0, 1, 1, 0]
    described = [scene.building.describe(k) for k in range(len(rooms))]
    assert [room["area_m2"] for room in described] == pytest.approx(AREAS_M2, rel=0.15)
    assert [door.rooms for door in rooms.doors] == [(0, 3), (1, 2)]
    assert all(0.5 < door.width_m < DOOR_M for door in rooms.doors)
    assert [room["doors"][0]["to_room"] for room in described] == [4, 3, 2, 1]
    for number, (x, y, storey) in enumerate(VISITED):
        place = np.array([[x, y, storey * STOREY_M]])
        cell = scene.building.spaces[storey].grid.cells_of(se3.transform_points(T_MAP_WORLD, place))
        assert rooms.numbers_of(storey)[tuple(cell[0])] == number


def test_the_graph_leads_from_the_building_to_storeys_rooms_and_objects(scene):
    content = scene_graph(scene).content
    nodes = {node["id"]: node for node in content["nodes"]}
    assert list(nodes) == list(range(len(nodes)))
    assert np.diff(content["graph"]["storeys_m"]) == pytest.approx([STOREY_M], abs=0.05)
    above = {}
    for edge in content["edges"]:
        if nodes[edge["target"]]["kind"] in ("room", "storey", "building"):
            above.setdefault(edge["source"], []).append((edge["relation"], edge["target"]))
    for kind, storey in itertools.product(("table", "lamp"), (0, 1)):
        number = numbers(scene, kind)[storey]
        ((relation, room),) = above[number]
        assert relation == "in" and nodes[number]["storey"] == nodes[room]["storey"] == storey + 1
        ((relation, level),) = [up for up in above[room] if up[0] == "part of"]
        assert nodes[level]["name"] == f"storey {storey + 1}"
        ((relation, top),) = above[level]
        assert nodes[top]["kind"] == "building"
    ceilings = [nodes[k]["storey"] for k in numbers(scene, "ceiling")]
    assert ceilings == [1, 2]


def test_relations_stay_on_one_storey(scene):
    for relation in scene.relations:
        ends = scene.storeys[relation.source], scene.storeys[relation.target]
        assert set(ends[0]) & set(ends[1]), relation
    floors = numbers(scene, "floor")
    for storey, table in enumerate(numbers(scene, "table")):
        on = [r.target for r in scene.relations if (r.source, r.kind) == (table, "on")]
        assert on == [floors[storey]]


def test_paths_stay_on_one_storey(scene):
    tables, lamps = numbers(scene, "table"), numbers(scene, "lamp")
    up = scene.ground.up
    for storey in (0, 1):
        path = scene.path(scene.place(lamps[storey]), scene.place(tables[storey]), 0.4)
        heights_m = path.points_m @ up - scene.building.floors.storeys.heights_m[storey]
        np.testing.assert_allclose(heights_m, 0.0, atol=1e-6)
    said = f"table {tables[0]} is on storey 1 and lamp {lamps[1]} is on storey 2"
    with pytest.raises(NoPathError, match=said):
        scene.path(scene.place(tables[0]), scene.place(lamps[1]), 0.4)


def test_each_storey_has_a_plan_and_a_branch_of_the_tree(scene, house, tmp_path):
    both = export_floor_plan(tmp_path / "plan.png", select(house), PlanOptions(rooms=True), OPTIONS)
    assert both.rooms == 4
    image = read_rgb(tmp_path / "plan.png")
    plan = report_floor_plan(
        house / "map.ply", TAXONOMY, np.zeros((0, 3)), METRES, scene_graph(scene).content
    )
    for rows, columns in (image.shape[:2], plan.image.shape[:2]):
        assert columns > 2 * rows  # plans of 8 m x 6.5 m beside each other
    floor_m2 = next(area.area_m2 for area in plan.areas if area.name == "floor")
    assert floor_m2 == pytest.approx(2 * 8.0 * 5.0, rel=0.1)
    assert len(plan.objects) == 4
    shown = [(one.storey, one.room) for one in graph_objects(scene_graph(scene).content)]
    assert shown == sorted(shown) and {storey for storey, _ in shown} == {"storey 1", "storey 2"}


def test_what_a_view_sees_of_another_storey_is_not_its_space():
    floors = Floors(Ground(np.array([0.0, 0.0, 1.0]), 0.0), Storeys([0.0, STOREY_M]))
    # Looking straight down from 1.5 m above the upper floor, in which a part is open.
    T_map_camera = se3.from_rotation_translation(
        np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, STOREY_M + 1.5])
    )
    depth_m = np.array([[[1.5, 1.5, STOREY_M + 1.5]]], np.float32)
    views = KeyframeViews(Camera(9.0, 9.0, 1.0, 0.0, 3, 1), [7], T_map_camera[None], depth_m)
    seen = views_on(views, floors, 1)
    assert seen.frames == [7] and seen.depth_m.tolist() == [[[1.5, 1.5, 0.0]]]
    assert len(views_on(views, floors, 0)) == 0 and views.depth_m.all()


def test_one_storey_has_no_further_level(tmp_path):
    scene = map_scene(select(house_run(tmp_path / "run", (0,))), OPTIONS)
    content = scene_graph(scene).content
    assert {node["kind"] for node in content["nodes"]} == {"object", "structure", "room"}
    assert len(content["graph"]["storeys_m"]) == 1
    assert {node["storey"] for node in content["nodes"]} == {1}
    assert {one.storey for one in graph_objects(scene_graph(scene).content)} == {""}
