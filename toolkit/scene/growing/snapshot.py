"""The graph of a growing scene in node-link format, as that of a finished map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.boxes import Ground, oriented_box
from toolkit.scene.graph.node_link import rooms_of_object, scene_content
from toolkit.scene.graph.relations import Relation, Role
from toolkit.scene.graph.scene import box_values
from toolkit.scene.graph.storeys import Floors, StoreyKind, find_storeys
from toolkit.scene.growing.objects import GrowingObject
from toolkit.scene.growing.rooms import GrowingBuilding, ViewFan
from toolkit.semantics.taxonomy import Node, Taxonomy

Array = NDArray[np.float64]

# Objects of fewer voxels, or of a single keyframe, are noise.
_MIN_VOXELS, _MIN_VIEWS = 6, 2


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
    """Return nodes and edges as `export --format scene-graph` writes them, without their frame.

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
    nodes = [_object_node(snapshot, n, floors, building) for n in kept]
    return scene_content(
        nodes, snapshot.relations, building, snapshot.ground, floors.storeys, taxonomy
    )


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


def _object_node(
    snapshot: Snapshot, number: int, floors: Floors, building: GrowingBuilding
) -> dict[str, Any]:
    one, points_m = snapshot.objects[number], snapshot.points_m[number]
    node, encloses = snapshot.nodes[number], snapshot.roles[number] != "object"
    storeys = _storeys_of(snapshot, floors, number)
    return {
        "id": number,
        "kind": "structure" if encloses else "object",
        "name": node.name,
        "path": list(node.path),
        "voxels": one.size,
        "confidence": round(one.confidence, 4),
        "box": box_values(oriented_box(points_m, snapshot.ground)),
        "colour": one.colour,
        "rooms": [room + 1 for room in rooms_of_object(building, points_m, storeys, encloses)],
        "storey": storeys[0] + 1,
        "first_seen": one.first,
        "last_seen": one.last,
        "keyframes": one.views,
    }
