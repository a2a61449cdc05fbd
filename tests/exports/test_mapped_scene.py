"""Rooms and changes of the layouts of synthetic rooms, whose truth is known."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layout_run import T_MAP_WORLD, changed, layout_run, make_run

from toolkit.base.errors import SettingsError
from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms.layouts import LAYOUTS, build_parts
from toolkit.exports.map_changes import changes_between
from toolkit.exports.mapped_scene import MappedScene, map_scene
from toolkit.exports.options import ObjectGraphOptions
from toolkit.exports.selection import select

OPTIONS = ObjectGraphOptions(link_m=0.2, min_gaussians=20)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> dict[str, MappedScene]:
    folder = tmp_path_factory.mktemp("layouts")
    return {
        name: map_scene(select(layout_run(folder / name, name)), OPTIONS)
        for name in ("rooms", "ring")
    }


def rooms_at(scene: MappedScene, *places: tuple[float, float]) -> list[int]:
    """Room at places of the world."""
    points = se3.transform_points(T_MAP_WORLD, np.array([(x, y, 0.0) for x, y in places]))
    (space,) = scene.building.spaces
    return space.rooms.numbers[tuple(space.grid.cells_of(points).T)].tolist()


@pytest.mark.parametrize("name", ["rooms", "ring"])
def test_the_rooms_are_those_of_the_layout(scenes, name):
    scene, plans = scenes[name], LAYOUTS[name]().rooms
    (space,) = scene.building.spaces
    assert len(scene.building.rooms) == len(plans)
    centres = rooms_at(scene, *(plan.centre_m for plan in plans))
    assert sorted(centres) == list(range(len(plans)))
    for plan, number in zip(plans, centres, strict=True):
        area_m2 = plan.size_m[0] * plan.size_m[1]
        assert space.rooms.areas_m2[number] == pytest.approx(area_m2, rel=0.25)
    # Both layouts begin in their first room, and are walked through in order.
    assert centres[0] == 0
    expected = {"ring": {(0, 1), (1, 2), (2, 3), (0, 3)}}.get(name)
    doors = {door.rooms for door in scene.building.rooms.doors}
    corridor = centres[-1]
    assert doors == (expected or {tuple(sorted((corridor, k))) for k in centres[:-1]})
    assert all(0.7 < door.width_m < 1.1 for door in scene.building.rooms.doors)


def test_objects_are_in_their_rooms(scenes):
    scene = scenes["ring"]
    beds = [k for k, found in enumerate(scene.objects) if found.node.name == "bed"]
    (bedroom,) = rooms_at(scene, LAYOUTS["ring"]().rooms[2].centre_m)
    assert beds and all(scene.rooms_of(k) == [bedroom] for k in beds)
    floors = [k for k, found in enumerate(scene.objects) if found.node.name == "floor"]
    assert set(itertools.chain(*map(scene.rooms_of, floors))) == set(range(4))
    wardrobe = next(k for k, o in enumerate(scene.objects) if o.node.name == "wardrobe")
    described = scene.describe(wardrobe)
    assert described["rooms"] == [bedroom + 1]
    assert described["keyframes"] > 0 and described["colour"] == "grey"
    # The bedroom is the third of four rooms.
    frames = len(scene.views)
    assert 0.3 * frames < described["first_seen"] <= described["last_seen"] < 0.8 * frames


def test_paths_lead_through_the_corridor(scenes):
    scene = scenes["rooms"]
    beds, tables = (
        [k for k, found in enumerate(scene.objects) if found.node.name == name]
        for name in ("bed", "table")
    )
    path = scene.path(scene.place(beds[0]), scene.place(tables[0]), 0.4)
    (space,) = scene.building.spaces
    rooms = space.rooms.numbers[tuple(space.grid.cells_of(path.points_m).T)]
    (corridor,) = rooms_at(scene, LAYOUTS["rooms"]().rooms[3].centre_m)
    assert corridor in rooms
    assert scene.rooms_of(beds[0])[0] == rooms[0] != rooms[-1]


def test_a_moved_and_a_removed_object_are_found(tmp_path):
    layout = LAYOUTS["room"]()
    parts = build_parts(layout, 0)
    before, after = (
        map_scene(select(make_run(Path(tmp_path / name), layout, content)), OPTIONS)
        for name, content in (("before", parts), ("after", changed(parts)))
    )
    found = changes_between(before, after, np.eye(4))
    assert {(c.kind, c.name) for c in found.changes} == {
        ("moved", "chair"),
        ("gone", "exercise-ball"),
    }
    moved = next(c for c in found.changes if c.kind == "moved")
    assert moved.values()["distance_m"] == pytest.approx(np.hypot(1.5, 0.6), abs=0.05)
    assert not changes_between(before, before, np.eye(4)).changes
    selection = before.selection
    unscaled = replace(selection, run=replace(selection.run, metric=False))
    with pytest.raises(SettingsError, match=r"run before .*arbitrary units.*--scale"):
        changes_between(replace(before, selection=unscaled), after, np.eye(4))
