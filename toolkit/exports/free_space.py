"""The free floor of a map and its rooms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.exports.floors import covering, occupancy_grid
from toolkit.exports.options import GridOptions
from toolkit.exports.selection import SelectedGaussians
from toolkit.io.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from toolkit.runs.maps.visibility import KeyframeViews
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.roles import ENCLOSING_NAMES
from toolkit.scene.graph.rooms import RoomMap, RoomOptions, closed, find_rooms, free_floor
from toolkit.scene.graph.scene import WALL_NAMES

Mask = NDArray[np.bool_]

# Without a class of walls, everything at this height above the floor counts as a wall.
_HIGH_M = 1.2
# Largest hole of the observed floor that is filled, in square metres: gaps between Gaussians, and
# floor inside a room that furniture hides from the camera.
_MAX_GAP_M2, _MAX_HIDDEN_M2 = 0.04, 4.0
# Interval of the rows of a depth image whose rays are drawn on the grid.
_ROW_STEP = 6
# What is at most this far behind the wall of a room belongs to it.
_WALL_M = 0.3


@dataclass(frozen=True)
class FreeSpace:
    """The free floor of a map.

    Attributes:
        grid: free, occupied and unknown cells; gaps between Gaussians of the floor are free.
        rooms: rooms on the grid.
    """

    grid: OccupancyGrid
    rooms: RoomMap

    def rooms_of(self, points_m: NDArray[np.float64]) -> dict[int, float]:
        """Return the share of points [N, 3] that lie in each room; walls belong to the nearest."""
        numbers = self._near_numbers[tuple(self.grid.cells_of(points_m).T)]
        found, counts = np.unique(numbers[numbers >= 0], return_counts=True)
        return {int(k): float(n) / len(points_m) for k, n in zip(found, counts, strict=True)}

    @cached_property
    def _near_numbers(self) -> NDArray[np.int32]:
        """Room of each cell [H, W], also in the walls around it."""
        numbers = self.rooms.numbers
        if not (numbers >= 0).any():
            return numbers
        distance, nearest = cv2.distanceTransformWithLabels(
            (numbers < 0).astype(np.uint8),
            cv2.DIST_L2,
            cv2.DIST_MASK_5,
            labelType=cv2.DIST_LABEL_PIXEL,
        )
        table = np.full(int(nearest.max()) + 1, -1, np.int32)
        table[nearest[numbers >= 0]] = numbers[numbers >= 0]
        return np.where(distance * self.grid.cell_m <= _WALL_M, table[nearest], -1)


def free_space(
    selection: SelectedGaussians,
    ground: Ground,
    views: KeyframeViews,
    options: GridOptions | None = None,
    room_options: RoomOptions | None = None,
) -> FreeSpace:
    """Return the free floor of the selected Gaussians and its rooms, largest first.

    Args:
        ground: plane of the floor.
        views: what keyframes see on this floor.

    Raises:
        ToolkitError: the grid is too large, or no Gaussian is opaque.
    """
    options = options or GridOptions()
    opaque = selection.opaque()
    means_m, radii_m = opaque.means_m, opaque.gaussians.radii_seen_m(ground.up)
    raw = occupancy_grid(means_m, radii_m, ground, options)
    heights_m = se3.transform_points(raw.T_grid_map, means_m)[:, 2]
    within = (heights_m >= options.min_height_m) & (heights_m <= options.max_height_m)
    walls = _walls(opaque, heights_m, options.max_height_m) & within
    cells = covering(raw, means_m[walls], radii_m[walls]) >= options.min_gaussians
    inside = _inside(raw, cells, _seen_through(raw, views))
    grid = _without_gaps(raw)
    free = free_floor(grid.cells == FREE, grid.cells_of(views.T_map_camera[:, :3, 3]), grid.cell_m)
    return FreeSpace(grid, find_rooms(inside, raw.cell_m, room_options, cells, free))


def _walls(opaque: SelectedGaussians, heights_m: NDArray[np.float64], max_height_m: float) -> Mask:
    """Return the mask [N] of the Gaussians of what encloses rooms."""
    if opaque.labels is not None:
        labelled = opaque.labelled()
        if labelled.selected(labelled.known(WALL_NAMES)).any():
            return labelled.selected(labelled.known(ENCLOSING_NAMES))
    return heights_m >= min(_HIGH_M, max_height_m)


def _seen_through(grid: OccupancyGrid, views: KeyframeViews) -> Mask:
    """Return the cells [H, W] over which keyframes have looked: space inside rooms."""
    image = np.zeros(grid.cells.shape, np.uint8)
    for view, T_map_camera in enumerate(views.T_map_camera):
        points_m, known = views.end_points(view)
        for row in range(0, len(known), _ROW_STEP):
            if not known[row].any():
                continue
            fan = np.vstack([T_map_camera[:3, 3], points_m[row][known[row]]])
            cells = grid.cells_of(fan)[:, ::-1].astype(np.int32)
            cv2.fillPoly(image, [np.ascontiguousarray(cells)], 1)
    return image.astype(bool)


def _inside(grid: OccupancyGrid, walls: Mask, looked: Mask) -> Mask:
    """Return the cells [H, W] of rooms: seen space, observed floor and furniture, no walls."""
    seen = closed(((grid.cells != UNKNOWN) | looked).astype(np.uint8))
    return _filled(seen & ~walls, ~seen & ~walls, _MAX_HIDDEN_M2 / grid.cell_m**2)


def _without_gaps(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the grid with the small unknown spots of its floor free."""
    free = grid.cells == FREE
    filled = _filled(free, grid.cells == UNKNOWN, _MAX_GAP_M2 / grid.cell_m**2)
    cells = np.where(filled & (grid.cells != OCCUPIED), FREE, grid.cells).astype(np.int8)
    return OccupancyGrid(cells, grid.cell_m, grid.origin_m, grid.T_grid_map)


def _filled(mask: Mask, gaps: Mask, max_cells: float) -> Mask:
    """Add the connected gaps to a mask that are not larger than some cells, nor at the border."""
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(gaps.astype(np.uint8), connectivity=4)
    rows, columns = mask.shape
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right = left + stats[:, cv2.CC_STAT_WIDTH]
    bottom = top + stats[:, cv2.CC_STAT_HEIGHT]
    inner = (left > 0) & (top > 0) & (right < columns) & (bottom < rows)
    small = inner & (stats[:, cv2.CC_STAT_AREA] <= max_cells)
    small[0] = False  # what is no gap
    return mask | small[pieces]
