"""The objects of a scene graph as the viewer shows them."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.tools.viewer.shown_objects import graph_objects, read_graph_objects


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


def test_objects_of_a_graph_are_in_order_with_their_relations():
    objects = graph_objects(GRAPH)
    found = [(one.number, one.name, one.room, one.relations) for one in objects]
    assert found == [
        (5, "table 5", "room 1", ("on floor 2", "next to chair 7")),
        (3, "lamp 3", "room 2", ()),
        (7, "chair 7", "", ("next to table 5",)),
    ]
    assert objects[0].path == ("thing", "table") and objects[0].voxels_m is None
    assert objects[0].corners_m[0].tolist() == [0.0, -2.0, -1.0]
    assert objects[0].corners_m[1].tolist() == [2.0, -2.0, -1.0]


def test_objects_name_their_storey_if_there_are_several():
    nodes = [one | {"storey": 2} if one.get("name") == "lamp" else one for one in GRAPH["nodes"]]
    graph = GRAPH | {"graph": {"storeys_m": [0.0, 3.0]}, "nodes": nodes}
    found = [(one.storey, one.room, one.name) for one in graph_objects(graph)]
    assert found == [
        ("storey 1", "room 1", "table 5"),
        ("storey 1", "", "chair 7"),
        ("storey 2", "room 2", "lamp 3"),
    ]


def test_a_damaged_graph_is_one_error(tmp_path):
    file = tmp_path / "scene_graph.json"
    assert read_graph_objects(file) == ()
    file.write_text('{"nodes": [{"id": 1}]}')
    with pytest.raises(FormatError, match=r"scene_graph\.json is damaged .*remove it"):
        read_graph_objects(file)
