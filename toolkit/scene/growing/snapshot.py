"""The graph of a growing scene in node-link format, as that of a finished map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.boxes import Ground, oriented_box
from toolkit.scene.graph.relations import Relation, Role
from toolkit.scene.graph.scene import box_values
from toolkit.scene.graph.storey_rooms import add_storeys, graph_edge
from toolkit.scene.graph.storeys import Floors, StoreyKind, find_storeys
from toolkit.scene.growing.objects import GrowingObject
from toolkit.scene.growing.rooms import GrowingBuilding, ViewFan
from toolkit.semantics.taxonomy import Node, Taxonomy

Array = NDArray[np.float64]

# Objects of fewer voxels, or of a single keyframe, are noise.
_MIN_VOXELS, _MIN_VIEWS = 6, 2
_PART_SHARE = 0.05


@dataclass(frozen=True)
class Snapshot:
    """A growing scene at one time; all dictionaries are by the number of the object.

    Attributes:
        objects: the objects.
        points_m: [n, 3] points of each in the world.
        roles: of each.
        nodes: class of each.
        floors: numbers of floors and rugs.
        relations: between objects.
        ground: plane of the floor.
        fans: what keyframes looked through.
        poses: [4, 4] pose of each submap, by its number.
    """

    objects: Mapping[int, GrowingObject]
    points_m: Mapping[int, Array]
    roles: Mapping[int, Role]
    nodes: Mapping[int, Node]
    floors: Sequence[int]
    relations: Sequence[Relation]
    ground: Ground
    fans: Sequence[ViewFan]
    poses: Mapping[int, Array]


def snapshot_content(snapshot: Snapshot, taxonomy: Taxonomy) -> dict[str, Any]:
    """Return nodes and edges as `export --format scene-graph` writes them, without `graph_frame`.

    The identifiers of objects are their numbers in the run, and stay while the scene grows. Those
    of rooms follow.
    """
    kept = [
        n
        for n, one in sorted(snapshot.objects.items())
        if one.size >= _MIN_VOXELS and one.views >= _MIN_VIEWS
    ]
    floors = _floors(snapshot)
    building = _building(snapshot, floors)
    storeys = {n: _storeys_of(snapshot, floors, n) for n in kept}
    room_of = {n: _rooms_of(snapshot, building, n, storeys[n]) for n in kept}
    nodes = [_object_node(snapshot, n, room_of[n], storeys[n][0]) for n in kept]
    first, rooms, shown = max(kept, default=-1) + 1, building.rooms, set(kept)
    nodes += [{"id": first + k, "kind": "room", **building.describe(k)} for k in range(len(rooms))]
    edges = [
        graph_edge(r.source, r.target, r.kind)
        for r in snapshot.relations
        if r.source in shown and r.target in shown
    ]
    for n in kept:
        kind = "in" if snapshot.roles[n] == "object" else "part of"
        edges += [graph_edge(n, first + room, kind) for room in room_of[n]]
    edges += [
        {
            **graph_edge(first + door.rooms[0], first + door.rooms[1], "connected to"),
            "width_m": round(door.width_m, 2),
        }
        for door in rooms.doors
    ]
    content = {
        "directed": True,
        "multigraph": True,
        "graph": {
            "up": snapshot.ground.up.round(6).tolist(),
            "floor_height_m": round(snapshot.ground.height_m, 4),
            "storeys_m": [round(h, 3) for h in floors.storeys.heights_m],
            "taxonomy": {"name": taxonomy.name, "digest": taxonomy.digest},
        },
        "nodes": nodes,
        "edges": edges,
    }
    add_storeys(content, floors.storeys)
    return content


def _building(snapshot: Snapshot, floors: Floors) -> GrowingBuilding:
    def points_of(*roles: Role) -> Array:
        found = [p for n, p in snapshot.points_m.items() if snapshot.roles[n] in roles]
        return np.concatenate([np.zeros((0, 3)), *found])

    fans = [fan.world_m(snapshot.poses) for fan in snapshot.fans]
    walls, ground, objects = points_of("wall", "opening"), points_of("floor"), points_of("object")
    return GrowingBuilding(floors, walls, ground, objects, fans)


def _floors(snapshot: Snapshot) -> Floors:
    heights = [snapshot.points_m[n] @ snapshot.ground.up for n in snapshot.floors]
    storeys = find_storeys(np.concatenate([np.zeros(0), *heights]), snapshot.ground.height_m)
    return Floors(snapshot.ground, storeys)


def _storeys_of(snapshot: Snapshot, floors: Floors, number: int) -> range:
    kind: StoreyKind = "object"
    if snapshot.roles[number] != "object":
        kind = "floor" if number in snapshot.floors else "structure"
    return floors.of_object(snapshot.points_m[number], kind)


def _rooms_of(
    snapshot: Snapshot, building: GrowingBuilding, number: int, storeys: range
) -> list[int]:
    shares = building.rooms_of(snapshot.points_m[number], storeys)
    if snapshot.roles[number] != "object":
        return sorted(room for room, share in shares.items() if share >= _PART_SHARE)
    return [max(shares, key=lambda k: shares[k])] if shares else []


def _object_node(
    snapshot: Snapshot, number: int, rooms: Sequence[int], storey: int
) -> dict[str, Any]:
    one, points_m = snapshot.objects[number], snapshot.points_m[number]
    node = snapshot.nodes[number]
    return {
        "id": number,
        "kind": "object" if snapshot.roles[number] == "object" else "structure",
        "name": node.name,
        "path": list(node.path),
        "voxels": one.size,
        "confidence": round(one.confidence, 4),
        "box": box_values(oriented_box(points_m, snapshot.ground)),
        "colour": one.colour,
        "rooms": [room + 1 for room in rooms],
        "storey": storey + 1,
        "first_seen": one.first,
        "last_seen": one.last,
        "keyframes": one.views,
    }
