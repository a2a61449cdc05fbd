"""Export the objects of a map, its rooms, storeys and their relations.

JSON is in the node-link format of NetworkX; JSON-LD and GraphML contain the same graph.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit.exports.mapped_scene import MappedScene, map_scene
from toolkit.exports.options import GridOptions, ObjectGraphOptions
from toolkit.exports.selection import SelectedGaussians
from toolkit.io.atomic import write_bytes
from toolkit.io.graphs import graph_bytes
from toolkit.scene.graph.storey_rooms import add_storeys, graph_edge, graph_frame


@dataclass(frozen=True)
class SceneGraph:
    """Objects, rooms and storeys (nodes) and their relations (edges) as JSON values."""

    content: dict[str, Any]

    def __str__(self) -> str:
        kinds = Counter(node["kind"] for node in self.content["nodes"])
        text = f"{kinds['object'] + kinds['structure']} objects, {kinds['room']} rooms, "
        text += f"{kinds['storey']} storeys, " if kinds["storey"] else ""
        return f"{text}{len(self.content['edges'])} relations"


def export_scene_graph(
    path: Path,
    selection: SelectedGaussians,
    options: ObjectGraphOptions,
    floor: Sequence[str] = (),
    grid: GridOptions | None = None,
) -> SceneGraph:
    """Write the scene graph of the selected Gaussians as .json, .jsonld or .graphml.

    Raises:
        ToolkitError: the map has no labels, no floor was found, or the file cannot be written.
    """
    graph = scene_graph(map_scene(selection, options, floor, grid))
    write_bytes(path, graph_bytes(graph.content, path.suffix.lower()))
    return graph


def scene_graph(scene: MappedScene) -> SceneGraph:
    """Return the graph of a scene: objects are numbered from 0, rooms and storeys behind them."""
    run, ground, count = scene.selection.run, scene.ground, len(scene.objects)
    building, storeys = scene.building, scene.building.floors.storeys
    nodes = [
        {"id": k, "kind": "structure" if scene.enclosing[k] else "object", **scene.describe(k)}
        for k in range(count)
    ]
    rooms = [
        {"id": count + k, "kind": "room", **scene.describe_room(k)}
        for k in range(len(building.rooms))
    ]
    edges = [graph_edge(r.source, r.target, r.kind) for r in scene.relations]
    edges += [
        graph_edge(k, count + room, "part of" if scene.enclosing[k] else "in")
        for k in range(count)
        for room in scene.rooms_of(k)
    ]
    edges += [
        {
            **graph_edge(count + door.rooms[0], count + door.rooms[1], "connected to"),
            "width_m": round(door.width_m, 2),
        }
        for door in building.rooms.doors
    ]
    taxonomy = scene.map.taxonomy
    content = {
        "directed": True,
        "multigraph": True,
        "graph": {
            **graph_frame(run.metric, run.origin_m.tolist()),
            "up": ground.up.round(6).tolist(),
            "floor_height_m": round(ground.height_m, 4),
            "storeys_m": [round(height_m, 3) for height_m in storeys.heights_m],
            "taxonomy": {"name": taxonomy.name, "digest": taxonomy.digest},
        },
        "nodes": [*nodes, *rooms],
        "edges": edges,
    }
    add_storeys(content, storeys)
    return SceneGraph(content)
