"""The tree of objects in the server's panel while a scene graph grows."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

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
    own = {"id": number, "kind": kind, "name": name, "path": ["thing", name], "storey": 1}
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


def table(number: int, left: float) -> ShownObject:
    """The half of the table of `two_panels` right of -0.5 m, or left of it, with its voxels."""
    x, y = np.meshgrid(np.arange(left, left + 0.4, 0.05), np.arange(-0.7, 0.7, 0.05))
    voxels_m = np.stack([x, y, np.full_like(x, 2.01)], axis=-1).reshape(-1, 3)
    unit = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
    corners_m = unit * (0.4, 1.4, 0.02) + (left, -0.7, 2.0)
    name, path = f"table {number}", ("furniture", "table")
    return ShownObject(number, name, "room 1", corners_m, path=path, voxels_m=voxels_m)


class Tree:
    """The tree of a server, and what it shows of a growing scene."""

    def __init__(self, server) -> None:
        self.shown = MapServer(server)
        self.show()

    def show(self, *objects: ShownObject) -> None:
        self.shown.show(replace(two_panels(), objects=objects))

    def click(self, x: float, y: float = 0.0) -> None:
        """Click at a point 2 m in front of the camera."""
        event = SimpleNamespace(ray_origin=(0.0, 0.0, 0.0), ray_direction=(x, y, 2.0))
        self.shown._controls._clicked(event)

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
    assert objects[0].path == ("thing", "table") and objects[0].voxels_m is None
    assert objects[0].size_m.tolist() == [2.0, 4.0, 6.0]
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
    assert "room 1, 1.00 x 1.00 x 1.00 m" in tree.tree._details.content
    assert "&lt;b&gt;" in tree.tree._details.content
    tree.show(shown(2, "lamp"))
    assert tree.tree._chosen is None and "No object" in tree.tree._details.content
    assert not tree.shown._view._mark


def test_a_click_in_the_view_chooses_the_object_of_the_gaussian(server):
    tree = Tree(server)
    tree.click(-0.3)
    assert tree.tree._chosen is None, "there are no objects so far"
    tree.show(table(4, left=-0.9), table(9, left=-0.5))
    tree.click(-0.3)
    assert tree.tree._chosen == 9 and "table 9" in tree.tree._details.content
    assert tree.tree._entries[9].button.color == "yellow" and tree.shown._view._mark
    tree.click(-0.7)
    assert tree.tree._chosen == 4
    tree.show(table(4, left=-0.9))
    assert tree.tree._chosen == 4, "the choice was lost"
    tree.click(0.5)
    assert tree.tree._chosen is None and "No object" in tree.tree._details.content, (
        "the wall is no object"
    )
    tree.click(-0.7)
    tree.click(5.0)
    assert tree.tree._chosen is None, "the background is no object"


def test_an_object_that_is_gone_is_not_chosen(server):
    """The scene of a click is replaced by one without the object before it is chosen."""
    tree = Tree(server)
    tree.show(table(4, left=-0.9))
    tree.tree.choose(77)
    assert tree.tree._chosen is None and "No object" in tree.tree._details.content


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


def test_a_click_on_gaussians_in_the_page_shows_the_card_of_their_object(server):
    tree = Tree(server)
    tree.show(table(4, left=-0.9), table(9, left=-0.5))
    start = server.initial_camera
    start.position, start.look_at = np.zeros(3), np.array([-0.3, 0.0, 2.0])
    with chromium() as browser:
        page = WatchedPage(browser).page
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        page.get_by_role("button", name="table 9").wait_for(timeout=30_000)
        page.mouse.click(450, 250)
        page.get_by_text("room 1, 0.40 x 1.40 x 0.02 m").wait_for(timeout=10_000)
        assert tree.tree._chosen == 9
