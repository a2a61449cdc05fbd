"""Export the objects of a map and their relations as JSON, in the node-link format of NetworkX."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit.exports.floors import required_ground
from toolkit.exports.options import ObjectGraphOptions
from toolkit.exports.selection import SelectedGaussians
from toolkit.io.atomic import write_bytes
from toolkit.semantics.query import CEILING_NAMES, FLOOR_NAMES, LabelledMap, ObjectOptions
from toolkit.semantics.relations import RelationOptions, Role, relations
from toolkit.semantics.scene import WALL_NAMES, SceneReader


@dataclass(frozen=True)
class SceneGraph:
    """Objects (nodes) and their relations (edges) as JSON values."""

    content: dict[str, Any]

    def __str__(self) -> str:
        return f"{len(self.content['nodes'])} objects, {len(self.content['edges'])} relations"


def export_scene_graph(
    path: Path, selection: SelectedGaussians, options: ObjectGraphOptions, floor: Sequence[str] = ()
) -> SceneGraph:
    """Write the scene graph of the selected Gaussians.

    Raises:
        ToolkitError: the map has no labels, no floor was found, or the file cannot be written.
    """
    graph = scene_graph(selection, options, floor)
    text = json.dumps(graph.content, indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, (text + "\n").encode())
    return graph


def scene_graph(
    selection: SelectedGaussians, options: ObjectGraphOptions, floor: Sequence[str] = ()
) -> SceneGraph:
    """Return the objects of the selected Gaussians and their relations.

    Raises:
        ToolkitError: the map has no labels, or no floor was found.
    """
    labelled = selection.labelled()
    ground = required_ground(selection, floor)
    object_options = ObjectOptions(options.link_m, options.min_gaussians)
    viewpoint_m = selection.run.tracked[0].T_map_camera[:3, 3]
    reader = SceneReader(labelled, object_options, viewpoint_m, floor or FLOOR_NAMES, ground)
    objects = labelled.objects(None, ground, object_options)
    floors = _paths(labelled, [*(floor or FLOOR_NAMES), *CEILING_NAMES])
    walls = _paths(labelled, WALL_NAMES)
    roles = [_role(found.node.path, floors, walls) for found in objects]
    found = relations(
        [labelled.means_m[o.index] for o in objects],
        ground,
        roles,
        RelationOptions(options.contact_m, options.next_to_m),
    )
    content = {
        "directed": True,
        "multigraph": True,
        "graph": {
            "frame": f"map of the run, {'metres' if selection.run.metric else 'arbitrary units'}",
            "metric": selection.run.metric,
            "map_origin_m": selection.run.origin_m.tolist(),
            "up": ground.up.round(6).tolist(),
            "floor_height_m": round(ground.height_m, 4),
            "taxonomy": {"name": labelled.taxonomy.name, "digest": labelled.taxonomy.digest},
        },
        "nodes": [{"id": k, **reader.describe(o)} for k, o in enumerate(objects)],
        "edges": [
            {"source": r.source, "target": r.target, "key": r.kind, "relation": r.kind}
            for r in found
        ],
    }
    return SceneGraph(content)


def _paths(labelled: LabelledMap, names: Sequence[str]) -> list[tuple[str, ...]]:
    return [labelled.taxonomy.find(name).path for name in labelled.known(names)]


def _role(
    path: tuple[str, ...], floors: Sequence[tuple[str, ...]], walls: Sequence[tuple[str, ...]]
) -> Role:
    if any(path[: len(other)] == other for other in floors):
        return "floor"
    return "wall" if any(path[: len(other)] == other for other in walls) else "object"
