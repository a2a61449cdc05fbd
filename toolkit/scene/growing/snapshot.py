"""A growing scene at one time, which viewers read and show as a graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.boxes import Ground, oriented_box
from toolkit.scene.graph.node_link import rooms_of_object, scene_content
from toolkit.scene.graph.relations import Relation, Role
from toolkit.scene.graph.roles import Roles
from toolkit.scene.graph.scene import box_values
from toolkit.scene.graph.storeys import Floors, find_storeys
from toolkit.scene.growing.rooms import GrowingBuilding
from toolkit.semantics.taxonomy import Taxonomy

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SeenObject:
    """An object of a growing scene.

    Attributes:
        number: from 1; it stays while the scene grows.
        class_id: of the taxonomy.
        colour: name of its most frequent colour.
        confidence: mean score of its masks, in [0, 1].
        first, last: frame indices of the first and the last keyframe that saw it.
        views: number of keyframes that saw it.
    """

    number: int
    class_id: int
    colour: str
    confidence: float
    first: int
    last: int
    views: int


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A growing scene.

    Attributes:
        objects: the objects.
        points_m: by the number of an object, a float32 point [n, 3] in each of its voxels.
        relations: between objects.
        ground: plane of the floor.
        fans_m: [F, 1 + R, D, 3] float32, what the keyframes looked through; see `ViewFan`.
    """

    objects: Sequence[SeenObject]
    points_m: dict[int, NDArray[np.float32]]
    relations: Sequence[Relation]
    ground: Ground
    fans_m: NDArray[np.float32]

    def content(self, taxonomy: Taxonomy) -> dict[str, Any]:
        """Return nodes and edges as `export --format scene-graph` writes them, without their frame.

        The identifiers of objects are their numbers. Those of rooms follow.
        """
        leaves = {one.number: taxonomy.leaf(one.class_id) for one in self.objects}
        roles = Roles(taxonomy)
        kinds = {number: roles.kind(leaf.path) for number, leaf in leaves.items()}
        points = {number: own.astype(np.float64) for number, own in self.points_m.items()}
        floors = self._floors([points[n] for n, kind in kinds.items() if kind == "floor"])
        by_role: dict[Role, list[Array]] = {}
        for number, leaf in leaves.items():
            by_role.setdefault(roles.of(leaf.path), []).append(points[number])
        building = self._building(floors, by_role)
        nodes = []
        for one in self.objects:
            points_m, node = points[one.number], leaves[one.number]
            encloses = kinds[one.number] != "object"
            storeys = floors.of_object(points_m, kinds[one.number])
            rooms = rooms_of_object(building, points_m, storeys, encloses)
            nodes.append(
                {
                    "id": one.number,
                    "kind": "structure" if encloses else "object",
                    "name": node.name,
                    "path": list(node.path),
                    "voxels": len(points_m),
                    "confidence": one.confidence,
                    "box": box_values(oriented_box(points_m, self.ground)),
                    "colour": one.colour,
                    "rooms": [room + 1 for room in rooms],
                    "storey": storeys[0] + 1,
                    "first_seen": one.first,
                    "last_seen": one.last,
                    "keyframes": one.views,
                }
            )
        return scene_content(nodes, self.relations, building, self.ground, floors.storeys, taxonomy)

    def _floors(self, floors_m: Sequence[Array]) -> Floors:
        heights = [points_m @ self.ground.up for points_m in floors_m]
        floor_m = np.concatenate([np.zeros(0), *heights])
        return Floors(self.ground, find_storeys(floor_m, self.ground.height_m))

    def _building(self, floors: Floors, by_role: dict[Role, list[Array]]) -> GrowingBuilding:
        def points_of(*roles: Role) -> Array:
            found = [points_m for role in roles for points_m in by_role.get(role, [])]
            return np.concatenate([np.zeros((0, 3)), *found])

        walls, ground = points_of("wall", "opening"), points_of("floor")
        fans_m = list(self.fans_m.astype(np.float64))
        return GrowingBuilding(floors, walls, ground, points_of("object"), fans_m)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values for `from_state`."""
        points = [self.points_m[one.number] for one in self.objects]
        arrays: dict[str, NDArray] = {
            "points_m": np.concatenate([np.zeros((0, 3), np.float32), *points]),
            "fans_m": self.fans_m,
            "up": self.ground.up,
        }
        values: dict[str, Any] = {
            "objects": [asdict(one) for one in self.objects],
            "voxels": [len(own) for own in points],
            "relations": [[r.source, r.target, r.kind] for r in self.relations],
            "height_m": self.ground.height_m,
        }
        return arrays, values

    @classmethod
    def from_state(cls, arrays: dict[str, NDArray], values: dict[str, Any]) -> Snapshot:
        """Restore a snapshot from its `state`."""
        objects = [SeenObject(**one) for one in values["objects"]]
        ends = np.cumsum(values["voxels"], dtype=np.int64)
        points = np.split(np.array(arrays["points_m"]), ends[:-1])
        return cls(
            objects,
            {one.number: own for one, own in zip(objects, points, strict=False)},
            [Relation(int(a), int(b), kind) for a, b, kind in values["relations"]],
            Ground(np.array(arrays["up"]), float(values["height_m"])),
            np.array(arrays["fans_m"]),
        )
