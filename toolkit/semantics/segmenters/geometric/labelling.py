"""Classification of the cells of a levelled grid and of their pixels."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.semantics.segmenters.geometric.levelled import LevelledGrid, Mask
from toolkit.semantics.segmenters.geometric.room import Room
from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid

VOID, FLOOR, WALL, CEILING, SURFACE, OBJECT = range(6)

Labels = NDArray[np.uint8]

# Minimum cosine between normal and up (or down) of horizontal cells, with a stricter threshold for
# the interior of surfaces; and between the normals of a cell and a wall.
_LEVEL, _STRICTLY_LEVEL = math.cos(math.radians(32.0)), math.cos(math.radians(15.0))
_ON_WALL, _IN_RECESS = math.cos(math.radians(40.0)), math.cos(math.radians(18.0))
# Maximum depth of doors and windows behind a wall; maximum extrapolation of a wall.
_RECESS_M, _BEYOND_M = 0.25, 0.8
# Minimum height above the floor, area, and fraction of strictly level cells of a surface.
_SURFACE_HEIGHT_M, _SURFACE_AREA_M2, _SURFACE_FRACTION = 0.12, 0.03, 0.3

# Penalty in 1/m for a cell without a plane.
_NO_PLANE = 1e-3


def label_cells(view: LevelledGrid, room: Room) -> Labels:
    """Return the class ids [h, w] of the cells."""
    labels = np.where(view.grid.valid, OBJECT, VOID).astype(np.uint8)
    for wall in room.walls.walls():
        labels[_on_wall(view, wall.normal, wall.offset_m, wall.span_m)] = WALL
    _label_levels(labels, view, room)
    floor = room.floor_height_m
    raised = view.grid.valid if floor is None else view.heights_m > floor + _SURFACE_HEIGHT_M
    labels[_surfaces(view, raised & (labels == OBJECT) & view.faces(_LEVEL))] = SURFACE
    return labels


def _on_wall(
    view: LevelledGrid, normal: NDArray[np.float64], offset_m: float, span_m: tuple[float, float]
) -> Mask:
    """Return the cells on a wall or in a recess of it; none if the wall is seen from behind."""
    grid = view.grid
    if float(normal @ view.T_map_camera[:3, 3]) < offset_m:
        return np.zeros_like(grid.valid)
    distance = view.along(normal) - np.float32(offset_m)
    along = view.along(np.cross(view.up, normal))
    facing = view.facing(normal)
    on = (np.abs(distance) < view.tolerance_m) & (~grid.oriented | (facing > _ON_WALL))
    on &= (along > span_m[0] - _BEYOND_M) & (along < span_m[1] + _BEYOND_M)
    recess = grid.oriented & (facing > _IN_RECESS) & (distance < 0) & (distance > -_RECESS_M)
    recess &= (along > span_m[0]) & (along < span_m[1])
    return np.asarray(grid.valid & (on | recess))


def _label_levels(labels: Labels, view: LevelledGrid, room: Room) -> None:
    """Label the floor and the ceiling in place."""
    floor, ceiling = room.floor_height_m, room.ceiling_height_m
    no_normal = ~view.grid.oriented & view.grid.valid
    facing_up, facing_down = view.faces(_LEVEL), view.faces(-1.0, -_LEVEL)
    if floor is not None:
        above = view.heights_m - np.float32(floor)
        on = (np.abs(above) < view.tolerance_m) & (facing_up | no_normal)
        # Horizontal cells below the floor are outliers or belong to a step down.
        on |= (above < 0) & facing_up
        on |= (np.abs(above) < 0.5 * view.tolerance_m) & (labels == OBJECT)
        labels[on] = FLOOR
    if ceiling is not None:
        below = np.float32(ceiling) - view.heights_m
        labels[(np.abs(below) < view.tolerance_m) & (facing_down | no_normal)] = CEILING


def _surfaces(view: LevelledGrid, candidates: Mask) -> Mask:
    """Return the candidates in sufficiently large connected horizontal components."""
    # Remove thin connections between a table and the objects on it.
    opened = cv2.morphologyEx(candidates.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2)))
    count, pieces = cv2.connectedComponents(opened, connectivity=4)
    strictly_level = candidates & (view.slope > _STRICTLY_LEVEL)
    cell_area = view.grid.areas_m2
    area = np.bincount(pieces.ravel(), cell_area.ravel(), count)
    level_area = np.bincount(pieces.ravel(), np.where(strictly_level, cell_area, 0).ravel(), count)
    large = (level_area > _SURFACE_AREA_M2) & (level_area > _SURFACE_FRACTION * area)
    large[0] = False  # background
    return np.asarray(large[pieces])


def label_pixels(
    cells: Labels, grid: SurfaceGrid, depth_m: NDArray[np.float32], camera: Camera
) -> NDArray[np.int32]:
    """Return the class ids [H, W] of the pixels.

    Each pixel takes the class of the neighbouring cell whose plane fits its depth best.
    """
    rows = np.minimum(np.arange(camera.height) // grid.block, cells.shape[0] - 1)
    columns = np.minimum(np.arange(camera.width) // grid.block, cells.shape[1] - 1)
    labels = cells[np.ix_(rows, columns)].astype(np.int32)
    borders = cv2.morphologyEx(cells, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    y, x = np.nonzero(borders[np.ix_(rows, columns)] & (depth_m > 0))
    rays = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    labels[y, x] = _best_neighbour(cells, grid, (rows[y], columns[x]), rays, 1 / depth_m[y, x])
    labels[depth_m <= 0] = VOID
    return labels


def _best_neighbour(
    cells: Labels,
    grid: SurfaceGrid,
    cell: tuple[NDArray[np.int64], NDArray[np.int64]],
    rays: tuple[NDArray[np.floating], NDArray[np.floating]],
    inverse_depth: NDArray[np.floating],
) -> Labels:
    """Return the labels [N] of pixels, from the 3x3 cells around each pixel's cell.

    Args:
        cells: [h, w] labels of the cells.
        grid: planes of the cells.
        cell: row and column [N] of the cell that contains each pixel.
        rays: x and y [N] of the intersection of each pixel's ray with the plane z = 1.
        inverse_depth: [N] in 1/m.
    """
    # A cell without a plane is compared by its inverse depth, with a penalty.
    fit = np.where(grid.oriented[..., None], grid.planes, 0.0)
    fit[..., 2] = np.where(grid.oriented, fit[..., 2], grid.inverse_depth)
    penalty = np.where(grid.oriented, 0.0, _NO_PLANE)
    fit[cells == VOID], penalty[cells == VOID] = 0.0, np.inf
    a, b, c = (np.ascontiguousarray(fit[..., k]).reshape(-1) for k in range(3))
    penalty = penalty.reshape(-1)

    best = np.full(len(inverse_depth), np.inf)
    chosen = np.zeros(len(inverse_depth), np.int64)
    height, width = cells.shape
    for down in (0, -1, 1):
        row = np.clip(cell[0] + down, 0, height - 1) * width
        for across in (0, -1, 1):
            index = row + np.clip(cell[1] + across, 0, width - 1)
            error = a[index] * rays[0]
            error += b[index] * rays[1]
            error += c[index]
            error -= inverse_depth
            np.abs(error, out=error)
            error += penalty[index]
            better = error < best
            np.copyto(best, error, where=better)
            np.copyto(chosen, index, where=better)
    return np.where(np.isfinite(best), cells.reshape(-1)[chosen], np.uint8(VOID))
