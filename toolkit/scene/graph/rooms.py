"""Rooms: the floor between walls, split at narrow passages.

The floor is flooded from the places farthest from walls. Two basins that meet at a passage become
two rooms if the passage is as narrow as a door and clearly narrower than both basins, else one
(a merge tree of the distance transform, as in watershed segmentation with a persistence test).
Furniture does not separate rooms: only walls count as obstacles. Where the floor ends because no
view shows more of it, it is not narrow. The gap that a wall seems to have behind furniture is no
door: nobody has seen free floor there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

# Number of cells that are flooded; finer grids are reduced to it.
_MAX_CELLS = 250_000
# Minimum area of a room that is wider than its door, in square metres: alcoves have less.
_MIN_CORE_M2 = 0.4
# The walls at both sides of a passage are found at most this far beyond the floor between them.
_JAMB_M = 0.15
# Half of the cells at most this far from the middle of a door are free floor.
_DOORSTEP_M = 0.25


@dataclass(frozen=True)
class RoomOptions:
    """Options of the segmentation into rooms.

    Attributes:
        max_door_m: maximum width of a passage between two rooms, in metres.
        min_door_m: passages narrower than this separate rooms, but are no doors: gaps of a wall.
        max_ratio: maximum width of a door relative to the width of the narrower room.
        min_area_m2: minimum area of a room in square metres; smaller ones join a neighbour.
    """

    max_door_m: float = 1.4
    min_door_m: float = 0.4
    max_ratio: float = 0.75
    min_area_m2: float = 1.5


@dataclass(frozen=True)
class Door:
    """The narrowest place between two rooms.

    Attributes:
        rooms: indices of the two rooms, the lower first.
        cell: row and column of its centre.
        width_m: free width between walls in metres.
    """

    rooms: tuple[int, int]
    cell: tuple[int, int]
    width_m: float


@dataclass(frozen=True)
class RoomMap:
    """Rooms on a grid.

    Attributes:
        numbers: [H, W] int32 index of the room of each cell, -1 outside of rooms.
        areas_m2: area of each room in square metres.
        centres: row and column of the cell of each room that is farthest from walls.
        doors: passages between rooms, widest first.
    """

    numbers: NDArray[np.int32]
    areas_m2: list[float]
    centres: list[tuple[int, int]]
    doors: list[Door]

    def __len__(self) -> int:
        """Number of rooms."""
        return len(self.areas_m2)

    def renumbered(self, visits: NDArray[np.intp]) -> RoomMap:
        """Return the rooms in the order of a path's first visits, then by decreasing area.

        The numbers of visited rooms stay the same while a map grows.

        Args:
            visits: [P] index of the room at each place of the path, -1 for none.
        """
        seen, first = np.unique(visits[visits >= 0], return_index=True)
        visited = seen[np.argsort(first)].tolist()
        rest = sorted(set(range(len(self))) - set(visited), key=lambda k: -self.areas_m2[k])
        order = [*visited, *rest]
        new = np.full(len(self) + 1, -1, np.int32)  # the last one stays -1
        new[order] = np.arange(len(order))
        doors = [
            Door((min(a, b), max(a, b)), door.cell, door.width_m)
            for door in self.doors
            for a, b in [(int(new[door.rooms[0]]), int(new[door.rooms[1]]))]
        ]
        areas_m2, centres = ([values[k] for k in order] for values in (self.areas_m2, self.centres))
        return RoomMap(new[self.numbers], areas_m2, centres, doors)


def find_rooms(
    inside: Mask,
    cell_m: float,
    options: RoomOptions | None = None,
    walls: Mask | None = None,
    free: Mask | None = None,
) -> RoomMap:
    """Split the floor between walls into rooms.

    Args:
        inside: [H, W] cells of the floor that are not walls.
        cell_m: edge of a cell in metres.
        options: options of the segmentation.
        walls: [H, W] cells of walls; all cells that are not inside if absent.
        free: [H, W] cells of free floor, which doors have; all cells that are inside if absent.

    Returns:
        The rooms, largest first.
    """
    options = options or RoomOptions()
    distance_m = _distance_m(inside, cell_m)
    step = max(1, math.ceil(math.sqrt(float(inside.sum()) / _MAX_CELLS)))
    near_walls = None
    if walls is not None:
        reach = 2 * math.ceil(_JAMB_M / cell_m) + 1
        near_walls = cv2.dilate(walls.astype(np.float32), np.ones((reach, reach), np.uint8))
        near_walls = _reduced(near_walls, step) > 0
    flood = _Flood(_reduced(distance_m, step), step * cell_m, options, near_walls)
    flood.run()
    coarse = flood.numbers()
    numbers = coarse.repeat(step, axis=0).repeat(step, axis=1)[: inside.shape[0], : inside.shape[1]]
    numbers = np.where(inside, numbers, -1).astype(np.int32)
    areas_m2, centres = [], []
    for number in range(int(coarse.max(initial=-1)) + 1):
        within = numbers == number
        areas_m2.append(float(within.sum()) * cell_m**2)
        row, column = np.unravel_index(np.where(within, distance_m, -1).argmax(), within.shape)
        centres.append((int(row), int(column)))
    doors = [
        Door((a, b), (row * step + step // 2, column * step + step // 2), width_m)
        for (a, b), (row, column), width_m in flood.doors()
    ]
    if free is not None:
        doors = [door for door in doors if _is_free(free, door.cell, cell_m)]
    found = RoomMap(numbers, areas_m2, centres, doors)
    return found.renumbered(np.argsort(-np.array(areas_m2), kind="stable"))


def closed(cells: NDArray[np.uint8]) -> Mask:
    """Return cells [H, W] without the gaps of one cell between them."""
    return cv2.morphologyEx(cells, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)).astype(bool)


def free_floor(floor: Mask, cameras: NDArray[np.integer], cell_m: float) -> Mask:
    """Return where somebody can walk: on observed floor, and where the camera passed.

    Args:
        floor: [H, W] cells of floor without obstacles.
        cameras: [P, 2] row and column of each position of the camera.
        cell_m: edge of a cell in metres.
    """
    free = floor.astype(np.uint8)
    for row, column in cameras.tolist():
        cv2.circle(free, (column, row), round(_DOORSTEP_M / cell_m), 1, -1)
    return free.astype(bool)


def _is_free(free: Mask, cell: tuple[int, int], cell_m: float) -> bool:
    reach = round(_DOORSTEP_M / cell_m)
    row, column = (max(place, reach) for place in cell)
    around = free[row - reach : row + reach + 1, column - reach : column + reach + 1]
    return bool(2 * around.sum() >= around.size)


def _distance_m(inside: Mask, cell_m: float) -> NDArray[np.float32]:
    """Return the distance [H, W] of cells to the border of the nearest cell outside, in metres."""
    padded = np.pad(inside.astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return np.where(inside, (distance - 0.5) * cell_m, 0.0).astype(np.float32)


def _reduced(distance_m: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """Return the maximum of each block of cells."""
    rows, columns = distance_m.shape
    padded = np.pad(distance_m, ((0, -rows % step), (0, -columns % step)))
    blocks = padded.reshape(padded.shape[0] // step, step, padded.shape[1] // step, step)
    return blocks.max(axis=(1, 3))


class _Flood:
    """Basins of a distance map, flooded from the largest distances down.

    Args:
        distance_m: [H, W] distance to the nearest wall, 0 outside.
        cell_m: edge of a cell in metres.
        options: what separates basins.
        near_walls: [H, W] cells at walls; None if everything outside is wall.
    """

    def __init__(
        self,
        distance_m: NDArray[np.float32],
        cell_m: float,
        options: RoomOptions,
        near_walls: Mask | None = None,
    ) -> None:
        self._shape = distance_m.shape
        self._cell_m2 = cell_m**2
        self._options = options
        padded = np.pad(distance_m, 1)
        self._width = w = padded.shape[1]
        self._axes = (1, w, w + 1, w - 1)
        self._distance = padded.ravel()
        self._near_walls = None if near_walls is None else np.pad(near_walls, 1).ravel()
        self._basin = np.full(padded.size, -1, np.int64)
        self._parent: list[int] = []
        self._peak: list[float] = []
        self._cells: list[int] = []
        self._doors: dict[frozenset[int], tuple[float, int]] = {}

    def run(self) -> None:
        """Flood all cells, then merge the basins that are too small."""
        order = np.argsort(-self._distance, kind="stable")
        for cell in order[: int((self._distance > 0).sum())].tolist():
            self._add(cell)
        self._merge_small()

    def _add(self, cell: int) -> None:
        w = self._width
        around = (1, -1, w, -w, w + 1, w - 1, 1 - w, -w - 1)
        basins = {self._root(int(self._basin[cell + k])) for k in around}
        basins.discard(-1)
        height = float(self._distance[cell])
        if not basins:
            self._basin[cell] = len(self._parent)
            self._parent.append(len(self._parent))
            self._peak.append(height)
            self._cells.append(1)
            return
        main, *others = sorted(basins, key=lambda k: -self._peak[k])
        for other in others:
            pair = frozenset((self._root(main), self._root(other)))
            if len(pair) < 2 or pair in self._doors:
                continue
            if self._is_door(pair, height) and self._between_walls(cell):
                self._doors[pair] = (height, cell)
            else:
                main = self._merge(pair)
        nearest = max(around, key=lambda k: (self._basin[cell + k] >= 0, self._distance[cell + k]))
        owner = self._root(int(self._basin[cell + nearest]))
        self._basin[cell] = owner
        self._cells[owner] += 1

    def _is_door(self, pair: frozenset[int], height: float) -> bool:
        smaller = min(pair, key=lambda k: self._peak[k])
        return (
            2.0 * height <= self._options.max_door_m
            and height <= self._options.max_ratio * self._peak[smaller]
            and min(self._cells[k] for k in pair) * self._cell_m2 >= _MIN_CORE_M2
        )

    def _between_walls(self, cell: int) -> bool:
        """Whether walls bound a passage where it is narrowest."""
        if self._near_walls is None:
            return True
        across = []
        for step in self._axes:
            first, last = self._end(cell, step), self._end(cell, -step)
            rows, columns = np.subtract(divmod(first, self._width), divmod(last, self._width))
            across.append((math.hypot(rows, columns), first, last))
        _, first, last = min(across)
        return bool(self._near_walls[first] and self._near_walls[last])

    def _end(self, cell: int, step: int) -> int:
        """The first cell outside in one direction."""
        while self._distance[cell] > 0:
            cell += step
        return cell

    def _merge(self, pair: frozenset[int]) -> int:
        """Merge two basins into the one with the higher peak, with its doors."""
        keep, gone = sorted(pair, key=lambda k: -self._peak[k])
        self._parent[gone] = keep
        self._cells[keep] += self._cells[gone]
        for other in [o for o in self._doors if gone in o]:
            place = self._doors.pop(other)
            (neighbour,) = other - {gone}
            if neighbour != keep:
                moved = frozenset((keep, neighbour))
                self._doors[moved] = max(place, self._doors.get(moved, place))
        return keep

    def _merge_small(self) -> None:
        """Merge rooms below the minimum area into the neighbour with the widest door."""
        small = self._options.min_area_m2 / self._cell_m2
        for pair, _ in sorted(self._doors.items(), key=lambda item: -item[1][0]):
            roots = frozenset(self._root(k) for k in pair)
            if len(roots) == 2 and min(self._cells[k] for k in roots) < small:
                self._merge(roots)

    def _root(self, basin: int) -> int:
        if basin < 0:
            return -1
        while self._parent[basin] != basin:
            self._parent[basin] = self._parent[self._parent[basin]]
            basin = self._parent[basin]
        return basin

    def _rooms(self) -> list[int]:
        """Return the basins that are large enough."""
        small = self._options.min_area_m2 / self._cell_m2
        return [k for k, p in enumerate(self._parent) if k == p and self._cells[k] >= small]

    def numbers(self) -> NDArray[np.int32]:
        """Return the index [H, W] of the room of each cell, -1 for none."""
        new = {basin: number for number, basin in enumerate(self._rooms())}
        table = [new.get(self._root(k), -1) for k in range(len(self._parent))]
        rooms = np.array([*table, -1], np.int32)[self._basin]
        return rooms.reshape(-1, self._width)[1:-1, 1:-1]

    def doors(self) -> list[tuple[tuple[int, int], tuple[int, int], float]]:
        """Return rooms, row and column, and width of each door, widest first."""
        new = {basin: number for number, basin in enumerate(self._rooms())}
        found = []
        for pair, (height, cell) in sorted(self._doors.items(), key=lambda item: -item[1][0]):
            if all(k in new for k in pair) and 2.0 * height >= self._options.min_door_m:
                a, b = sorted(new[k] for k in pair)
                row, column = divmod(cell, self._width)
                found.append(((a, b), (row - 1, column - 1), 2.0 * height))
        return found
