"""The storeys of a map: free floor and rooms of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.exports.free_space import FreeSpace, free_space
from toolkit.exports.options import GridOptions
from toolkit.exports.selection import SelectedGaussians
from toolkit.runs.maps.visibility import KeyframeViews
from toolkit.scene.graph.rooms import RoomOptions
from toolkit.scene.graph.storey_rooms import StoreyRooms, numbered_rooms
from toolkit.scene.graph.storeys import Floors

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Building:
    """Free floor and rooms of each storey.

    Attributes:
        floors: heights of the storeys.
        spaces: free floor of each storey, the lowest first; their grids have the same cells.
        rooms: all rooms.
    """

    floors: Floors
    spaces: Sequence[FreeSpace]
    rooms: StoreyRooms

    def rooms_of(self, points_m: Array, storeys: range) -> dict[int, float]:
        """Return the share of points [N, 3] in each room; see `StoreyRooms.shares`."""
        return self.rooms.shares(
            points_m, storeys, self.floors, lambda storey, own: self.spaces[storey].rooms_of(own)
        )

    def describe(self, number: int) -> dict[str, Any]:
        """Return area, place and doors of a room as JSON values."""
        return self.rooms.describe(number, self.spaces[0].grid.cell_m, self.point)

    def point(self, storey: int, cell: tuple[int, int]) -> Array:
        """Return the point [3] on the floor of a storey at the centre of a cell."""
        return np.asarray(self.spaces[storey].grid.points_of(np.array([cell]))[0])


def find_building(
    selection: SelectedGaussians,
    floors: Floors,
    views: KeyframeViews,
    options: GridOptions,
    room_options: RoomOptions,
) -> Building:
    """Return the free floor and the rooms of each storey of the selected Gaussians.

    Rooms are numbered in the order in which the camera first visits them.

    Args:
        views: what the keyframes of the run see.

    Raises:
        ToolkitError: the grid is too large, or no Gaussian is opaque.
    """
    cameras_m = np.array([f.T_map_camera[:3, 3] for f in selection.run.tracked]).reshape(-1, 3)
    at = floors.at(cameras_m)
    spaces, visits = [], []
    for storey in range(len(floors.storeys)):
        # What is higher belongs to the next floor.
        max_height_m = min(options.max_height_m, floors.storeys.headroom_m(storey))
        space = free_space(
            selection,
            floors.of(storey),
            views_on(views, floors, storey),
            replace(options, max_height_m=max_height_m),
            room_options,
        )
        cells = tuple(space.grid.cells_of(cameras_m).T)
        rooms = space.rooms.renumbered(np.where(at == storey, space.rooms.numbers[cells], -1))
        spaces.append(replace(space, rooms=rooms))
        visits.append(np.where(at == storey, rooms.numbers[cells], -1))
    return Building(floors, spaces, numbered_rooms([s.rooms for s in spaces], visits))


def views_on(views: KeyframeViews, floors: Floors, storey: int) -> KeyframeViews:
    """Return the views from a storey, with depth only where they see the same storey."""
    if len(floors.storeys) == 1:
        return views
    chosen = np.flatnonzero(floors.at(views.T_map_camera[:, :3, 3]) == storey)
    depth_m = views.depth_m[chosen]
    for number, view in enumerate(chosen.tolist()):
        points_m, _ = views.end_points(view)
        at = floors.at(points_m.reshape(-1, 3)).reshape(points_m.shape[:2])
        depth_m[number][at != storey] = 0.0
    frames = [views.frames[view] for view in chosen]
    return KeyframeViews(views.camera, frames, views.T_map_camera[chosen], depth_m)
