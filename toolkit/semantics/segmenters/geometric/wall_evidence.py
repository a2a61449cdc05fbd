"""Evidence from one view on whether a vertical plane is a wall or furniture.

Walls reach the ceiling, and there is no parallel surface behind them. The front of a cupboard ends
below the ceiling, more distant surfaces are visible above it, and there is a wall behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.segmenters.geometric.levelled import LevelledGrid, Mask
from toolkit.semantics.segmenters.geometric.patches import PlanarPatch
from toolkit.semantics.segmenters.geometric.surface_grid import moved

Array = NDArray[np.float64]

# Sine of the maximum deviation of a plane from the vertical.
_MAX_TILT = math.sin(math.radians(12.0))
# Percentage of the cells at each end that spans and heights exclude.
_TAIL_PERCENT = 2.0
# Height of the band below the highest point that is the top edge.
_TOP_M = 0.15
# Numbers of cells above the top edge that are examined, to cross its irregular border and holes.
_STEPS = (3, 5, 8, 12)
# Distances of a parallel surface behind the plane, and search margin to its sides, in metres.
_BEHIND_M, _BESIDE_M = (0.1, 1.0), 0.7
_PARALLEL = 0.93


@dataclass(frozen=True)
class PlaneObservation:
    """A vertical plane observed in one frame, in the map frame.

    Lengths of its top edge are in image widths.

    Attributes:
        normal: [3] horizontal unit normal, towards the camera.
        offset_m: normal . x of its points.
        span_m: minimum and maximum coordinate along up x normal.
        heights_m: minimum and maximum height.
        free_top: length of the top edge below a more distant surface.
        ceiling_top: length of the top edge adjacent to a surface that faces down.
        ended_top: length of the top edge that is observed.
        cut_top: length of the top edge at the image border or at missing depth.
        cells: number of cells on the plane.
        cells_behind: number of cells on parallel surfaces a short distance behind the plane,
            visible beside or above it.
    """

    normal: Array
    offset_m: float
    span_m: tuple[float, float]
    heights_m: tuple[float, float]
    free_top: float
    ceiling_top: float
    ended_top: float
    cut_top: float
    cells: float
    cells_behind: float


def observe(view: LevelledGrid, patch: PlanarPatch) -> PlaneObservation | None:
    """Return the observation of a patch, or None if it is not vertical."""
    tilt = float(patch.normal @ view.up_camera)
    if abs(tilt) > _MAX_TILT:
        return None
    horizontal = patch.normal - tilt * view.up_camera
    normal = view.T_map_camera[:3, :3] @ (horizontal / np.linalg.norm(horizontal))
    across = np.cross(view.up, normal)

    distance, along = view.along(normal), view.along(across)
    offset = float(np.median(distance[patch.cells]))
    ends = (_TAIL_PERCENT, 100.0 - _TAIL_PERCENT)
    left, right = (float(v) for v in np.percentile(along[patch.cells], ends))
    bottom, top = (float(v) for v in np.percentile(view.heights_m[patch.cells], ends))

    distance_behind = offset - distance
    outside = (along < left) | (along > right) | (view.heights_m > top)
    near = (along > left - _BESIDE_M) & (along < right + _BESIDE_M) & (view.heights_m > bottom)
    min_distance = _BEHIND_M[0] + 0.03 * view.grid.depth_m
    behind = view.grid.oriented & (view.facing(normal) > _PARALLEL)
    behind &= (distance_behind > min_distance) & (distance_behind < _BEHIND_M[1]) & outside & near

    edge = patch.cells & (view.heights_m > top - _TOP_M)
    free, ceiling, ended, cut = _top_edge(view, patch.cells, edge, distance_behind)
    return PlaneObservation(
        normal=normal,
        offset_m=offset,
        span_m=(left, right),
        heights_m=(bottom, top),
        free_top=free,
        ceiling_top=ceiling,
        ended_top=ended,
        cut_top=cut,
        cells=float(patch.cells.sum()),
        cells_behind=float(behind.sum()),
    )


def _top_edge(
    view: LevelledGrid, cells: Mask, edge: Mask, distance_behind: NDArray[np.float32]
) -> tuple[float, float, float, float]:
    """Return the lengths of the top edge that are free, meet a ceiling, end, and are cut off."""
    grid = view.grid
    up = view.up_camera[:2] / max(float(np.linalg.norm(view.up_camera[:2])), 1e-6)
    down_facing = view.faces(-1.0, -0.8)
    farther = distance_behind > 0.05 + 0.015 * grid.depth_m
    open_edge, free, ceiling = np.zeros_like(cells), np.zeros_like(cells), np.zeros_like(cells)
    for step in _STEPS:
        across, down = (-round(step * float(part)) for part in up)
        own = moved(cells, down, across, False)
        if step == _STEPS[0]:
            open_edge = edge & ~own
            total = open_edge.sum()
        seen = open_edge & moved(grid.valid, down, across, False)
        free |= seen & moved(farther, down, across, False) & ~own
        ceiling |= seen & moved(down_facing & (distance_behind < 0), down, across, False)
        open_edge &= ~seen
    # The edge mask is as thick as the first step.
    width = cells.shape[1] * _STEPS[0]
    cut = open_edge.sum()
    return (
        float(free.sum() / width),
        float(ceiling.sum() / width),
        float((total - cut) / width),
        float(cut / width),
    )
