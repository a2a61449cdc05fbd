"""Rooms of all storeys, numbered together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.rooms import Door, RoomMap
from toolkit.scene.graph.storeys import Floors

Array = NDArray[np.float64]

_DECIMALS = 4  # of lengths in metres: 0.1 mm


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

    def shares(
        self,
        points_m: Array,
        storeys: range,
        floors: Floors,
        rooms_of: Callable[[int, Array], Mapping[int, float]],
    ) -> dict[int, float]:
        """Return the share of points [N, 3] in each room of some storeys, by number.

        Points count on their own storey if there are several, else all on the only one.

        Args:
            rooms_of: returns the share of points [n, 3] in each room of a storey, by index.
        """
        at = floors.at(points_m) if len(storeys) > 1 else np.full(len(points_m), storeys[0])
        return {
            self.number(storey, room): share * float((at == storey).mean())
            for storey in storeys
            for room, share in rooms_of(storey, points_m[at == storey]).items()
        }

    def describe(
        self, number: int, cell_m: float, point_m: Callable[[int, tuple[int, int]], Array]
    ) -> dict[str, Any]:
        """Return area, place and doors of a room as JSON values.

        Args:
            number: of the room.
            cell_m: edge of a cell.
            point_m: returns the point [3] of a cell (row, column) of a storey.
        """
        storey, index = self.order[number]
        rooms = self.maps[storey]
        flat_m = np.argwhere(rooms.numbers == index) * cell_m
        return {
            "name": f"room {number + 1}",
            "number": number + 1,
            "storey": storey + 1,
            "area_m2": round(rooms.areas_m2[index], 2),
            "size_m": (np.ptp(flat_m, axis=0)[::-1] + cell_m).round(2).tolist(),
            "centre_m": point_m(storey, rooms.centres[index]).round(_DECIMALS).tolist(),
            "doors": [
                {
                    "to_room": 1 + self.number(storey, (set(door.rooms) - {index}).pop()),
                    "width_m": round(door.width_m, 2),
                    "place_m": point_m(storey, door.cell).round(_DECIMALS).tolist(),
                }
                for door in rooms.doors
                if index in door.rooms
            ],
        }

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
