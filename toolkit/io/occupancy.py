"""Two-dimensional occupancy grids as ROS's map_server reads them: an image and a YAML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from toolkit.io.atomic import write_bytes, write_text

# Grey values that map_saver writes for the three states of a cell. map_server turns a value v into
# the probability (255 - v) / 255 and compares it with the thresholds below.
OCCUPIED_GREY, FREE_GREY, UNKNOWN_GREY = 0, 254, 205
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196

UNKNOWN, FREE, OCCUPIED = -1, 0, 100


@dataclass(frozen=True)
class OccupancyGrid:
    """A grid of the floor; x and y are horizontal, z is up, and the floor is at z = 0.

    Attributes:
        cells: [H, W] int8, rows along y and columns along x: -1 unknown, 0 free, 100 occupied, as
            in ROS's messages.
        cell_m: edge of a cell in metres.
        origin_m: x and y of the outer corner of cell (0, 0), in metres.
        T_grid_map: [4, 4] pose of the map in the frame of the grid.
    """

    cells: NDArray[np.int8]
    cell_m: float
    origin_m: tuple[float, float]
    T_grid_map: NDArray[np.float64]

    def __str__(self) -> str:
        rows, columns = self.cells.shape[0], self.cells.shape[1]
        cell_m2 = self.cell_m**2
        free_m2 = cell_m2 * int((self.cells == FREE).sum())
        occupied_m2 = cell_m2 * int((self.cells == OCCUPIED).sum())
        return f"{columns} x {rows} cells, {free_m2:.1f} m2 free, {occupied_m2:.1f} m2 occupied"

    def cells_of(self, points_m: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return row and column [N, 2] of the cells below points [N, 3] of the map.

        Points outside the grid belong to the nearest cell of its border.
        """
        last = np.array(self.cells.shape) - 1
        return np.clip(self._rows_columns(points_m), 0, last).astype(np.intp)

    def contains(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points [N, 3] of the map are above or below a cell of the grid."""
        places = self._rows_columns(points_m)
        return np.asarray(((places >= 0) & (places < self.cells.shape)).all(axis=1))

    def _rows_columns(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        places = points_m @ self.T_grid_map[:2, :3].T + self.T_grid_map[:2, 3]
        return np.floor((places - self.origin_m) / self.cell_m)[:, ::-1]

    def points_of(self, cells: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the points [N, 3] of the map on the floor at the centres of cells [N, 2]."""
        flat = (cells[:, ::-1] + 0.5) * self.cell_m + self.origin_m
        offset = np.column_stack([flat, np.zeros(len(flat))]) - self.T_grid_map[:3, 3]
        return offset @ self.T_grid_map[:3, :3]

    def mask_of(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return the mask [H, W] of the cells below points [N, 3] of the map."""
        mask = np.zeros(self.cells.shape, bool)
        mask[tuple(self.cells_of(points_m).T)] = True
        return mask


def write_occupancy_grid(
    path: Path, grid: OccupancyGrid, map_origin_m: NDArray[np.float64] | None = None
) -> None:
    """Write NAME.yaml and the image NAME.pgm beside it.

    Args:
        map_origin_m: [3] position of the map's origin in the coordinates of given poses; 0 if
            absent.

    Raises:
        RunFolderError: a file cannot be written.
    """
    image = np.full(grid.cells.shape, UNKNOWN_GREY, np.uint8)
    image[grid.cells == FREE] = FREE_GREY
    image[grid.cells == OCCUPIED] = OCCUPIED_GREY
    picture = path.with_suffix(".pgm")
    rows, columns = (int(side) for side in grid.cells.shape)
    # The first row of the image is the one with the largest y.
    write_bytes(picture, f"P5\n{columns} {rows}\n255\n".encode() + image[::-1].tobytes())
    content = {
        "image": picture.name,
        "mode": "trinary",
        "resolution": float(grid.cell_m),
        "origin": [*map(float, grid.origin_m), 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
        # Ignored by map_server; relates the grid to the poses of the run.
        "T_grid_map": grid.T_grid_map.tolist(),
        "map_origin_m": np.zeros(3).tolist() if map_origin_m is None else map_origin_m.tolist(),
    }
    write_text(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
