"""The graph of a scene in node-link format: objects, rooms and storeys, and their relations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.relations import Relation
from toolkit.scene.graph.storey_rooms import StoreyRooms
from toolkit.scene.graph.storeys import Storeys
from toolkit.semantics.taxonomy import Taxonomy

Array = NDArray[np.float64]

# What encloses rooms is part of each room that contains this share of it.
_PART_SHARE = 0.05


class RoomedBuilding(Protocol):
    """The rooms of all storeys."""

    @property
    def rooms(self) -> StoreyRooms:
        """All rooms."""

    def rooms_of(self, points_m: Array, storeys: range) -> dict[int, float]:
        """Return the share of points [N, 3] in each room; see `StoreyRooms.shares`."""

    def describe(self, number: int) -> dict[str, Any]:
        """Return area, place and doors of a room as JSON values."""


def rooms_of_object(
    building: RoomedBuilding, points_m: Array, storeys: range, encloses: bool
) -> list[int]:
    """Return the indices of the rooms of an object: one, or all that it encloses.

    Args:
        building: the rooms.
        points_m: [N, 3] points of the object.
        storeys: its storeys.
        encloses: whether it is part of rooms (walls, floors, doors, ...).
    """
    shares = building.rooms_of(points_m, storeys)
    if encloses:
        return sorted(room for room, share in shares.items() if share >= _PART_SHARE)
    return [max(shares, key=lambda k: shares[k])] if shares else []


def scene_content(
    objects: Sequence[dict[str, Any]],
    relations: Sequence[Relation],
    building: RoomedBuilding,
    ground: Ground,
    storeys: Storeys,
    taxonomy: Taxonomy,
) -> dict[str, Any]:
    """Return nodes and edges; rooms and storeys are numbered behind the objects.

    Args:
        objects: the nodes of the objects, with `id`, `kind` ("object" or "structure"), and the
            numbers of their `rooms` and of their `storey`, from 1.
        relations: between objects by their numbers; those of others are left out.
        building: the rooms.
        ground: plane of the floor, of the lowest storey.
        storeys: the storeys.
        taxonomy: classes of the objects.
    """
    shown = {node["id"] for node in objects}
    first = max(shown, default=-1) + 1
    rooms = [
        {"id": first + k, "kind": "room", **building.describe(k)}
        for k in range(len(building.rooms))
    ]
    edges = [
        graph_edge(r.source, r.target, r.kind)
        for r in relations
        if r.source in shown and r.target in shown
    ]
    edges += [
        graph_edge(node["id"], first + room - 1, "in" if node["kind"] == "object" else "part of")
        for node in objects
        for room in node["rooms"]
    ]
    edges += [
        {
            **graph_edge(first + door.rooms[0], first + door.rooms[1], "connected to"),
            "width_m": round(door.width_m, 2),
        }
        for door in building.rooms.doors
    ]
    content = {
        "directed": True,
        "multigraph": True,
        "graph": {
            "up": ground.up.round(6).tolist(),
            "floor_height_m": round(ground.height_m, 4),
            "storeys_m": [round(height_m, 3) for height_m in storeys.heights_m],
            "taxonomy": {"name": taxonomy.name, "digest": taxonomy.digest},
        },
        "nodes": [*objects, *rooms],
        "edges": edges,
    }
    _add_storeys(content, storeys)
    return content


def in_frame(
    content: dict[str, Any], metric: bool, map_origin_m: Sequence[float]
) -> dict[str, Any]:
    """Return a graph with its unit of length, and its origin in given poses."""
    frame = {
        "frame": f"map of the run, {'metres' if metric else 'arbitrary units'}",
        "metric": metric,
        "map_origin_m": list(map_origin_m),
    }
    return content | {"graph": frame | content["graph"]}


def _add_storeys(content: dict[str, Any], storeys: Storeys) -> None:
    """Add the storeys of a scene graph in node-link format, if there are several.

    Rooms are part of storeys, and storeys of the building. What is in no room is in (or part of)
    its storey. A graph of one storey stays as it is: its rooms need no further level.

    Args:
        content: the graph; objects and rooms have the number of their `storey`, from 1.
        storeys: the storeys.
    """
    if len(storeys) == 1:
        return
    nodes, edges = content["nodes"], content["edges"]
    rooms = [node for node in nodes if node["kind"] == "room"]
    first, count = 1 + max(node["id"] for node in nodes), len(storeys)
    for node in list(nodes):
        if node["kind"] != "room" and node["rooms"]:
            continue
        kind = "in" if node["kind"] == "object" else "part of"
        edges.append(graph_edge(node["id"], first + node["storey"] - 1, kind))
    for number, height_m in enumerate(storeys.heights_m, 1):
        own = [room for room in rooms if room["storey"] == number]
        described = {
            "id": first + number - 1,
            "kind": "storey",
            "name": f"storey {number}",
            "number": number,
            "floor_height_m": round(height_m, 3),
            "area_m2": round(sum(room["area_m2"] for room in own), 2),
            "rooms": [room["number"] for room in own],
        }
        edges.append(graph_edge(described["id"], first + count, "part of"))
        nodes.append(described)
    nodes.append({"id": first + count, "kind": "building", "name": "building", "storeys": count})


def graph_edge(source: int, target: int, kind: str) -> dict[str, Any]:
    """Return an edge in node-link format."""
    return {"source": source, "target": target, "key": kind, "relation": kind}
