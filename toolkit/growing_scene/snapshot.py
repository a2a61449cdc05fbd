"""The graph of a growing scene in node-link format, as that of a finished map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.growing_scene.objects import GrowingObject
from toolkit.growing_scene.rooms import GrowingRooms, ViewFan
from toolkit.semantics.boxes import Ground, oriented_box
from toolkit.semantics.relations import Relation, Role
from toolkit.semantics.scene import box_values
from toolkit.semantics.storeys import Storeys, find_storeys
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

    def local(self, points_m: Array) -> Array:
        """Points [n, 3] along the axes of the floor, with the height above it."""
        return points_m @ self.ground.axes - [0.0, 0.0, self.ground.height_m]

    def point_m(self, place: Array) -> list[float]:
        """A place [2] on the floor as a point of the world."""
        world = self.ground.axes @ np.append(place, self.ground.height_m)
        return world.round(4).tolist()


def snapshot_content(snapshot: Snapshot, taxonomy: Taxonomy) -> dict[str, Any]:
    """Return nodes and edges as `export --format scene-graph` writes them.

    The identifiers of objects are their numbers in the run, and stay while the scene grows. Those
    of rooms follow.
    """
    kept = [
        n
        for n, one in sorted(snapshot.objects.items())
        if one.size >= _MIN_VOXELS and one.views >= _MIN_VIEWS
    ]
    rooms = _rooms(snapshot)
    room_of = {n: _rooms_of(snapshot, rooms, n) for n in kept}
    storeys = _storeys(snapshot)
    nodes = [_object_node(snapshot, n, room_of[n], storeys) for n in kept]
    first_room = max(kept, default=-1) + 1
    nodes += _room_nodes(snapshot, rooms, first_room)
    shown = set(kept)
    edges = [
        _edge(r.source, r.target, r.kind)
        for r in snapshot.relations
        if r.source in shown and r.target in shown
    ]
    for n in kept:
        kind = "in" if snapshot.roles[n] == "object" else "part of"
        edges += [_edge(n, first_room + room, kind) for room in room_of[n]]
    edges += [
        {
            **_edge(first_room + door.rooms[0], first_room + door.rooms[1], "connected to"),
            "width_m": round(door.width_m, 2),
        }
        for door in rooms.rooms.doors
    ]
    return {
        "directed": True,
        "multigraph": True,
        "graph": {
            "frame": "map of the run, metres",
            "up": snapshot.ground.up.round(6).tolist(),
            "floor_height_m": round(snapshot.ground.height_m, 4),
            "storeys_m": [round(h, 3) for h in storeys.heights_m],
            "taxonomy": {"name": taxonomy.name, "digest": taxonomy.digest},
        },
        "nodes": nodes,
        "edges": edges,
    }


def _rooms(snapshot: Snapshot) -> GrowingRooms:
    local = {n: snapshot.local(p) for n, p in snapshot.points_m.items()}
    walls = [p for n, p in local.items() if snapshot.roles[n] in ("wall", "opening")]
    inside = [p for n, p in local.items() if snapshot.roles[n] in ("object", "floor")]
    fans = [snapshot.local(fan.world_m(snapshot.poses)) for fan in snapshot.fans]
    none = np.zeros((0, 3))
    return GrowingRooms(np.concatenate([none, *walls]), np.concatenate([none, *inside]), fans)


def _rooms_of(snapshot: Snapshot, rooms: GrowingRooms, number: int) -> list[int]:
    shares = rooms.rooms_of(snapshot.local(snapshot.points_m[number]))
    if snapshot.roles[number] != "object":
        return sorted(room for room, share in shares.items() if share >= _PART_SHARE)
    return [max(shares, key=lambda k: shares[k])] if shares else []


def _storeys(snapshot: Snapshot) -> Storeys:
    heights = [snapshot.points_m[n] @ snapshot.ground.up for n in snapshot.floors]
    return find_storeys(np.concatenate([np.zeros(0), *heights]), snapshot.ground.height_m)


def _object_node(
    snapshot: Snapshot, number: int, rooms: Sequence[int], storeys: Storeys
) -> dict[str, Any]:
    one, points_m = snapshot.objects[number], snapshot.points_m[number]
    node = snapshot.nodes[number]
    bottom_m = float(np.percentile(points_m @ snapshot.ground.up, 2))
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
        "storey": storeys.of(bottom_m) + 1,
        "first_seen": one.first,
        "last_seen": one.last,
        "keyframes": one.views,
    }


def _room_nodes(snapshot: Snapshot, rooms: GrowingRooms, first: int) -> list[dict[str, Any]]:
    found = rooms.rooms
    return [
        {
            "id": first + k,
            "kind": "room",
            "name": f"room {k + 1}",
            "number": k + 1,
            "area_m2": round(found.areas_m2[k], 2),
            "size_m": rooms.size_m(k),
            "centre_m": snapshot.point_m(rooms.place(found.centres[k])),
            "doors": [
                {
                    "to_room": 1 + (set(door.rooms) - {k}).pop(),
                    "width_m": round(door.width_m, 2),
                    "place_m": snapshot.point_m(rooms.place(door.cell)),
                }
                for door in found.doors
                if k in door.rooms
            ],
        }
        for k in range(len(found))
    ]


def _edge(source: int, target: int, kind: str) -> dict[str, Any]:
    return {"source": source, "target": target, "key": kind, "relation": kind}
