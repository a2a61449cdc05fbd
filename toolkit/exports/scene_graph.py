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
from toolkit.scene.graph.node_link import in_frame, scene_content


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
    nodes = [
        {"id": k, "kind": "structure" if scene.enclosing[k] else "object", **scene.describe(k)}
        for k in range(len(scene.objects))
    ]
    content = scene_content(
        nodes,
        scene.relations,
        scene.building,
        scene.ground,
        scene.building.floors.storeys,
        scene.map.taxonomy,
    )
    run = scene.selection.run
    return SceneGraph(in_frame(content, run.metric, run.origin_m.tolist()))
