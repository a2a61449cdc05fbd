"""Rooms of all storeys, numbered together, and the storeys of a scene graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.rooms import Door, RoomMap
from toolkit.semantics.storeys import Storeys


@dataclass(frozen=True)
class StoreyRooms:
    """Rooms of several storeys.

    Attributes:
        maps: rooms of each storey, the lowest first.
        order: storey of each room and its index there, by its number in the building.
    """

    maps: Sequence[RoomMap]
    order: Sequence[tuple[int, int]]

    def __len__(self) -> int:
        """Number of rooms."""
        return len(self.order)

    @property
    def doors(self) -> list[Door]:
        """Passages between rooms by their numbers in the building, the lowest storey first."""
        return [
            Door((min(a, b), max(a, b)), door.cell, door.width_m)
            for storey, rooms in enumerate(self.maps)
            for door in rooms.doors
            for a, b in [[self.number(storey, room) for room in door.rooms]]
        ]

    def number(self, storey: int, room: int) -> int:
        """Return the number in the building of a room of a storey."""
        return self._numbers[storey, room]

    def numbers_of(self, storey: int) -> NDArray[np.int32]:
        """Return the number in the building of the room of each cell [H, W], -1 for none."""
        rooms = self.maps[storey]
        table = [self.number(storey, room) for room in range(len(rooms))]
        return np.array([*table, -1], np.int32)[rooms.numbers]

    @cached_property
    def _numbers(self) -> dict[tuple[int, int], int]:
        return {place: number for number, place in enumerate(self.order)}


def numbered_rooms(maps: Sequence[RoomMap], visits: Sequence[NDArray[np.integer]]) -> StoreyRooms:
    """Number the rooms of all storeys in the order of first visits, then by decreasing area.

    Args:
        maps: rooms of each storey.
        visits: for each storey, the index [P] of the room at each place of the path; -1 for none,
            as where the path is on another storey.
    """
    rows = []
    for storey, (rooms, seen) in enumerate(zip(maps, visits, strict=True)):
        visited, first = np.unique(seen, return_index=True)
        places = dict(zip(visited.tolist(), first.tolist(), strict=True))
        rows += [
            (places.get(room, len(seen)), -area_m2, storey, room)
            for room, area_m2 in enumerate(rooms.areas_m2)
        ]
    return StoreyRooms(maps, [(storey, room) for _, _, storey, room in sorted(rows)])


def add_storeys(content: dict[str, Any], storeys: Storeys) -> None:
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
