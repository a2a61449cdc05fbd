"""Occupancy grids of the floor for robots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.exports.options import GridOptions
from toolkit.exports.selection import SelectedGaussians, floors_of
from toolkit.io.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, write_occupancy_grid
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.storeys import Floors

# Discs of this many standard deviations cover a surface without gaps between Gaussians.
_DISC_SIGMAS = 1.5
# Cells around the map, so that its border is not that of the image.
_MARGIN = 4
_MAX_CELLS = 100_000_000


def export_occupancy_grid(
    path: Path, selection: SelectedGaussians, options: GridOptions, floor: Sequence[str] = ()
) -> OccupancyGrid:
    """Write the occupancy grid of the selected Gaussians.

    Raises:
        ToolkitError: no floor was found, the grid is too large, or a file cannot be written.
    """
    ground = required_ground(selection, floor)
    opaque = selection.opaque()
    radii_m = opaque.gaussians.radii_seen_m(ground.up)
    grid = occupancy_grid(opaque.means_m, radii_m, ground, options)
    write_occupancy_grid(path, grid, selection.run.origin_m)
    return grid


def required_ground(selection: SelectedGaussians, floor: Sequence[str]) -> Ground:
    """Return the floor of a run, of its lowest storey.

    Raises:
        ToolkitError: it cannot be determined.
    """
    return required_floors(selection, floor).ground


def required_floors(selection: SelectedGaussians, floor: Sequence[str]) -> Floors:
    """Return the floors of all storeys of a run.

    Raises:
        ToolkitError: they cannot be determined.
    """
    floors = floors_of(selection.run, floor)
    if floors is None:
        raise ToolkitError(
            f"{selection.run.folder.path}: no floor was found, which this format needs; name its "
            "classes with --floor"
        )
    return floors


def occupancy_grid(
    means_m: NDArray[np.float64],
    radii_m: NDArray[np.float64],
    ground: Ground,
    options: GridOptions,
) -> OccupancyGrid:
    """Return the occupancy grid of Gaussians [N].

    A cell is occupied if enough Gaussians cover it within the height of the robot, free if it is
    not occupied and floor was observed there, else unknown.

    Raises:
        SettingsError: the grid is too large, or the range of heights is empty.
    """
    if options.min_height_m >= options.max_height_m:
        raise SettingsError(
            f"--grid.min-height-m {options.min_height_m:g} must be less than --grid.max-height-m "
            f"{options.max_height_m:g}"
        )
    T_grid_map = grid_from_map(ground)
    points_m = se3.transform_points(T_grid_map, means_m)
    height_m = points_m[:, 2]
    low = np.floor(points_m[:, :2].min(axis=0) / options.cell_m).astype(int) - _MARGIN
    high = np.floor(points_m[:, :2].max(axis=0) / options.cell_m).astype(int) + _MARGIN
    columns, rows = (high - low + 1).tolist()
    if rows * columns > _MAX_CELLS:
        raise SettingsError(
            f"the grid would have {columns} x {rows} cells; increase --grid.cell-m, or exclude "
            "distant Gaussians with --drop"
        )
    obstacle = (height_m >= options.min_height_m) & (height_m <= options.max_height_m)
    floor = np.abs(height_m) < options.min_height_m
    origin_m = (float(low[0] * options.cell_m), float(low[1] * options.cell_m))
    cells = np.full((rows, columns), UNKNOWN, np.int8)
    grid = OccupancyGrid(cells, options.cell_m, origin_m, T_grid_map)
    cells[covering(grid, means_m[floor], radii_m[floor]) > 0] = FREE
    occupied = covering(grid, means_m[obstacle], radii_m[obstacle]) >= options.min_gaussians
    cells[occupied] = OCCUPIED
    return grid


def covering(
    grid: OccupancyGrid, means_m: NDArray[np.float64], radii_m: NDArray[np.float64]
) -> NDArray[np.int32]:
    """Return the number [H, W] of Gaussians that cover each cell of a grid, all within it."""
    points_m = se3.transform_points(grid.T_grid_map, means_m)
    places = (points_m[:, :2] - grid.origin_m) / grid.cell_m
    rows, columns = grid.cells.shape
    return _counts(places, _DISC_SIGMAS * radii_m / grid.cell_m, (rows, columns))


def grid_from_map(ground: Ground) -> NDArray[np.float64]:
    """Return T_grid_map [4, 4]: z is up, and the floor is at z = 0."""
    T_grid_map = np.eye(4)
    T_grid_map[:3, :3] = ground.axes.T
    T_grid_map[2, 3] = -ground.height_m
    return T_grid_map


def _counts(
    places: NDArray[np.float64], radii: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.int32]:
    """Count the discs that cover each cell of a grid [H, W].

    Args:
        places: [N, 2] column and row of the centres, in cells from the outer corner.
        radii: [N] in cells; discs of less than a cell cover the cell of their centre.
    """
    counts = np.zeros(shape, np.int32)
    columns, rows = np.floor(places).astype(int).T
    sizes = np.rint(np.minimum(radii, 2 * _MARGIN)).astype(int)
    for size in np.unique(sizes):
        of_size = sizes == size
        hits = np.zeros(shape, np.float32)
        np.add.at(hits, (rows[of_size], columns[of_size]), 1.0)
        if size > 0:
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size + 1, 2 * size + 1))
            hits = cv2.filter2D(hits, -1, disc.astype(np.float32), borderType=cv2.BORDER_CONSTANT)
        counts += np.rint(hits).astype(np.int32)
    return counts
