"""The tree of objects in the server's panel while a scene graph grows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from browser_pages import WatchedPage, chromium
from painted_scenes import two_panels

from toolkit.errors import FormatError
from toolkit.viewer.object_tree import ObjectTree
from toolkit.viewer.scene import ShownObject
from toolkit.viewer.server import MapServer, start_viser, stop_viser
from toolkit.viewer.shown_objects import graph_objects, read_graph_objects

pytest.importorskip("viser")


@pytest.fixture
def server():
    started = start_viser("127.0.0.1", 0)
    yield started
    stop_viser(started)


def node(number: int, name: str, kind: str = "object", rooms: tuple[int, ...] = (1,)) -> dict:
    box = {"centre_m": [1.0, 0.0, 2.0], "size_m": [2.0, 4.0, 6.0], "axes": np.eye(3).tolist()}
    own = {"id": number, "kind": kind, "name": name, "storey": 1}
    return {**own, "box": box, "rooms": list(rooms)}


GRAPH = {
    "graph": {"storeys_m": [0.0]},
    "nodes": [
        node(2, "floor", "structure"),
        node(7, "chair", rooms=()),
        node(3, "lamp", rooms=(2,)),
        node(5, "table"),
        {"id": 8, "kind": "room", "name": "room 1"},
        {"id": 9, "kind": "room", "name": "room 2"},
    ],
    "edges": [
        {"source": 5, "target": 2, "relation": "on"},
        {"source": 7, "target": 5, "relation": "next to"},
        {"source": 5, "target": 8, "relation": "in"},
    ],
}


def shown(number: int, name: str, room: str = "room 1") -> ShownObject:
    corners_m = np.array([[i & 1, i >> 1 & 1, 2 + (i >> 2)] for i in range(8)], float)
    return ShownObject(number, f"{name} {number}", room, corners_m, (f"on <b>floor</b> {number}",))


class Tree:
    """The tree of a server, and what it shows of a growing scene."""

    def __init__(self, server) -> None:
        self.shown = MapServer(server)
        self.show()

    def show(self, *objects: ShownObject) -> None:
        self.shown.show(replace(two_panels(), objects=objects))

    @property
    def tree(self) -> ObjectTree:
        return self.shown._controls._objects

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of the buttons by label of the folder."""
        rooms = sorted(self.tree._rooms.values(), key=lambda folder: folder.order)
        return {
            folder.label: [
                b.label for b in sorted(folder._children.values(), key=lambda b: b.order)
            ]
            for folder in rooms
        }


def test_objects_of_a_graph_are_in_order_with_their_relations():
    objects = graph_objects(GRAPH)
    found = [(one.number, one.name, one.room, one.relations) for one in objects]
    assert found == [
        (5, "table 5", "room 1", ("on floor 2", "next to chair 7")),
        (3, "lamp 3", "room 2", ()),
        (7, "chair 7", "", ("next to table 5",)),
    ]
    assert objects[0].corners_m[0].tolist() == [0.0, -2.0, -1.0]
    assert objects[0].corners_m[1].tolist() == [2.0, -2.0, -1.0]


def test_folders_name_the_storey_if_there_are_several(server):
    nodes = [one | {"storey": 2} if one.get("name") == "lamp" else one for one in GRAPH["nodes"]]
    graph = GRAPH | {"graph": {"storeys_m": [0.0, 3.0]}, "nodes": nodes}
    tree = Tree(server)
    tree.show(*graph_objects(graph))
    assert tree.names == {
        "storey 1, room 1 (1)": ["table 5"],
        "storey 1, no room (1)": ["chair 7"],
        "storey 2, room 2 (1)": ["lamp 3"],
    }


def test_a_damaged_graph_is_one_error(tmp_path):
    file = tmp_path / "scene_graph.json"
    assert read_graph_objects(file) == ()
    file.write_text('{"nodes": [{"id": 1}]}')
    with pytest.raises(FormatError, match=r"scene_graph\.json is damaged .*remove it"):
        read_graph_objects(file)


def test_the_tree_grows_and_keeps_entries_and_choice(server):
    tree = Tree(server)
    assert not tree.tree._folder.visible
    tree.show(shown(4, "table"), shown(9, "chair", ""))
    assert tree.tree._folder.visible
    assert tree.names == {"room 1 (1)": ["table 4"], "no room (1)": ["chair 9"]}
    folder, button = tree.tree._rooms["room 1"], tree.tree._entries[4].button
    tree.tree.choose(4)
    tree.show(shown(2, "lamp"), shown(4, "desk"), shown(9, "chair"))
    assert tree.names == {"room 1 (3)": ["lamp 2", "desk 4", "chair 9"]}
    # Browsers keep what is open in a folder, and the choice, while these are not replaced.
    assert tree.tree._rooms["room 1"] is folder and tree.tree._entries[4].button is button
    assert tree.tree._chosen == 4 and button.color == "yellow"
    assert "desk 4" in tree.tree._details.content
    assert "&lt;b&gt;" in tree.tree._details.content
    tree.show(shown(2, "lamp"))
    assert tree.tree._chosen is None and not tree.tree._details.visible
    assert not tree.shown._view._mark


def test_a_frame_that_is_a_keyframe_of_two_submaps_is_shown_twice(server):
    scene = two_panels()
    again = replace(scene.keyframes[0], submap=1)
    shown = MapServer(server)
    for _ in range(2):
        shown.show(replace(scene, keyframes=(*scene.keyframes, again)))
    assert len(shown._view._nodes["keyframes"]) == 3


def test_a_click_in_the_page_marks_an_object_while_the_tree_grows(server):
    tree = Tree(server)
    objects = [shown(4, "table"), shown(6, "vase", "room 2")]
    tree.show(*objects)
    with chromium() as browser:
        page = WatchedPage(browser).page
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        page.get_by_role("button", name="table 4").click(timeout=30_000)
        page.get_by_text("on <b>floor</b> 4").wait_for()
        page.get_by_text("room 2 (1)").click()
        page.get_by_role("button", name="vase 6").wait_for()
        tree.show(*objects, shown(8, "chair", "room 2"))
        page.get_by_role("button", name="chair 8").wait_for()
        page.get_by_text("room 2 (2)").wait_for()
        assert page.get_by_role("button", name="vase 6").is_visible(), "the room was closed"
        assert page.get_by_text("on <b>floor</b> 4").is_visible(), "the choice was lost"
