"""Rooms of a growing scene: walls and floors of its objects, and what the camera looked through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit.base.keyframe import Keyframe
from toolkit.scene.graph.rooms import RoomMap, closed, find_rooms, free_floor
from toolkit.scene.graph.storey_rooms import numbered_rooms
from toolkit.scene.graph.storeys import Floors

Array = NDArray[np.float64]

_CELL_M = 0.1
# Heights of what separates rooms; lower parts are floor.
_MIN_HEIGHT_M, _MAX_HEIGHT_M = 0.15, 1.8
# Directions of a keyframe that are drawn on the grid, and rows of the image in which they lie.
_DIRECTIONS, _ROWS = 24, (0.25, 0.5, 0.75)
# Objects belong to a room up to this distance outside of it.
_WALL_M = 0.35


@dataclass(frozen=True)
class ViewFan:
    """What a keyframe looked through.

    Attributes:
        submap: number of its submap.
        points_m: [1 + R, D, 3] in the frame of the submap: the camera, repeated, and the ends of
            rays in R rows of the image.
    """

    submap: int
    points_m: Array

    def camera_m(self, poses: Mapping[int, Array]) -> Array:
        """Position [3] of the camera in the world."""
        T = poses[self.submap]
        return np.asarray(T[:3, :3] @ self.points_m[0, 0] + T[:3, 3])

    def world_m(self, poses: Mapping[int, Array]) -> Array:
        """The points [1 + R, D, 3] in the world."""
        T = poses[self.submap]
        return np.asarray(self.points_m @ T[:3, :3].T + T[:3, 3])


def fan_of(submap: int, keyframe: Keyframe, metres_per_unit: float) -> ViewFan:
    """Return what a keyframe looks through, in metres."""
    height, width = keyframe.depth_m.shape
    columns = np.linspace(0, width - 1, _DIRECTIONS).astype(int)
    rows = [int(share * (height - 1)) for share in _ROWS]
    camera = keyframe.camera
    v, u = np.meshgrid(rows, columns, indexing="ij")
    z = keyframe.depth_m.numpy()[v, u].astype(np.float64)
    local = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    local = np.concatenate([np.zeros((1, len(columns), 3)), local])
    T = keyframe.T_map_camera
    return ViewFan(submap, (local @ T[:3, :3].T + T[:3, 3]) * metres_per_unit)


class GrowingRooms:
    """Rooms of a storey on a grid along the axes of the floor.

    Args:
        walls: [N, 3] points of what encloses rooms, along the axes of the floor; z is the height
            above it.
        floor: [M, 3] points of the floor.
        objects: [K, 3] points of objects.
        fans: [1 + R, D, 3] points of what each keyframe looked through.
        headroom_m: height up to the next floor.

    Attributes:
        rooms: the rooms, in the order of the keyframes' first visits.
        visits: [F] index of the room of each keyframe, -1 for none.
    """

    def __init__(
        self,
        walls: Array,
        floor: Array,
        objects: Array,
        fans: Sequence[Array],
        headroom_m: float = np.inf,
    ) -> None:
        cameras = np.array([fan[0, 0] for fan in fans]).reshape(-1, 3)
        flat = np.concatenate([part[:, :2] for part in (walls, floor, objects, cameras)])
        self._low = np.floor(flat.min(axis=0) / _CELL_M) - 2
        size = (np.ceil(flat.max(axis=0) / _CELL_M) - self._low + 2).astype(int)
        seen = np.zeros((int(size[1]), int(size[0])), np.uint8)
        x, y = self._cells(floor).T
        seen[y, x] = 1
        walkable = closed(seen)
        x, y = self._cells(objects).T
        seen[y, x] = 1
        for fan in fans:
            for row in fan[1:]:
                outline = np.vstack([fan[0, :1], row])
                cv2.fillPoly(seen, [self._cells(outline).astype(np.int32)], 1)
        wall = np.zeros(seen.shape, bool)
        max_height_m = min(_MAX_HEIGHT_M, headroom_m)
        high = (walls[:, 2] >= _MIN_HEIGHT_M) & (walls[:, 2] <= max_height_m)
        x, y = self._cells(walls[high]).T
        wall[y, x] = True
        at = self._cells(cameras)
        free = free_floor(walkable & ~wall, at[:, ::-1], _CELL_M)
        rooms = find_rooms(closed(seen) & ~wall, _CELL_M, walls=wall, free=free)
        x, y = at.T
        if fans:
            rooms = rooms.renumbered(rooms.numbers[y, x].astype(np.intp))
        self.rooms: RoomMap = rooms
        self.visits = rooms.numbers[y, x]
        cells = np.argwhere(rooms.numbers >= 0)
        self._tree = KDTree((cells[:, ::-1] + self._low + 0.5) * _CELL_M) if len(cells) else None
        self._numbers = rooms.numbers[tuple(cells.T)]

    def rooms_of(self, points: Array) -> dict[int, float]:
        """Share of points [N, 3] in each room; walls belong to the nearest one."""
        if self._tree is None or not len(points):
            return {}
        distance_m, nearest = self._tree.query(points[:, :2], distance_upper_bound=_WALL_M)
        found = self._numbers[nearest[np.isfinite(distance_m)]]
        numbers, counts = np.unique(found, return_counts=True)
        return {int(k): float(n) / len(points) for k, n in zip(numbers, counts, strict=True)}

    def place(self, cell: tuple[int, int]) -> Array:
        """The place [2] of a cell (row, column) along the axes of the floor."""
        return np.asarray((np.array(cell[::-1]) + self._low + 0.5) * _CELL_M)

    def _cells(self, points: Array) -> NDArray[np.int64]:
        return (np.floor(points[:, :2] / _CELL_M) - self._low).astype(np.int64)


class GrowingBuilding:
    """Rooms of all storeys.

    Args:
        floors: planes of the floors.
        walls: [N, 3] points of what encloses rooms, in the world.
        ground: [M, 3] points of floors.
        objects: [K, 3] points of objects.
        fans: [1 + R, D, 3] points of what each keyframe looked through.

    Attributes:
        rooms: all rooms, in the order of the keyframes' first visits.
    """

    def __init__(
        self, floors: Floors, walls: Array, ground: Array, objects: Array, fans: Sequence[Array]
    ) -> None:
        self._floors = floors
        cameras = floors.at(np.array([fan[0, 0] for fan in fans]).reshape(-1, 3))
        ground_at, objects_at = floors.at(ground), floors.at(objects)
        self._storeys, visits = [], []
        for storey in range(len(floors.storeys)):
            found = GrowingRooms(
                self._local(walls, storey),
                self._local(ground[ground_at == storey], storey),
                self._local(objects[objects_at == storey], storey),
                [
                    self._local(_seen_on(fan, floors, storey), storey)
                    for fan, at in zip(fans, cameras, strict=True)
                    if at == storey
                ],
                floors.storeys.headroom_m(storey),
            )
            rooms = np.full(len(fans), -1)
            rooms[cameras == storey] = found.visits
            self._storeys.append(found)
            visits.append(rooms)
        self.rooms = numbered_rooms([found.rooms for found in self._storeys], visits)

    def rooms_of(self, points_m: Array, storeys: range) -> dict[int, float]:
        """Share of points [N, 3] in each room; walls belong to the nearest one.

        See `StoreyRooms.shares`.
        """
        return self.rooms.shares(
            points_m,
            storeys,
            self._floors,
            lambda storey, own: self._storeys[storey].rooms_of(self._local(own, storey)),
        )

    def describe(self, number: int) -> dict[str, Any]:
        """Area, place and doors of a room as JSON values."""
        return self.rooms.describe(number, _CELL_M, self._point_m)

    def _local(self, points_m: Array, storey: int) -> Array:
        """Points [..., 3] along the axes of the floor, with the height above that of a storey."""
        ground = self._floors.of(storey)
        return np.asarray(points_m @ ground.axes - [0.0, 0.0, ground.height_m])

    def _point_m(self, storey: int, cell: tuple[int, int]) -> Array:
        """The centre of a cell (row, column) on the floor as a point [3] of the world."""
        ground, place = self._floors.of(storey), self._storeys[storey].place(cell)
        return np.asarray(ground.axes @ np.append(place, ground.height_m))


def _seen_on(fan: Array, floors: Floors, storey: int) -> Array:
    """The points of a fan, with the camera instead of those on other storeys."""
    at = floors.at(fan.reshape(-1, 3)).reshape(fan.shape[:2])
    return np.where((at == storey)[..., None], fan, fan[:1])
