"""What one view says about an upright plane: is it a wall, or a piece of furniture?

Walls go up to the ceiling, and nothing runs behind them. The front of a cupboard ends at
a height, with something farther away above it, and the wall goes on behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.segmenters.geometric.levelled import LevelledGrid, Mask
from toolkit.semantics.segmenters.geometric.patches import Patch
from toolkit.semantics.segmenters.geometric.surface_grid import moved

Array = NDArray[np.float64]

# The sine of how far from upright a plane may lean.
_MOST_LEAN = math.sin(math.radians(12.0))
# Spans and heights leave out this share of the cells at each end.
_TAIL_PERCENT = 2.0
# The top edge is what lies this close below the highest point.
_TOP_M = 0.15
# Cells to look up from the top edge, to get across its ragged border and small holes.
_STEPS = (3, 5, 8, 12)
# A parallel surface behind the plane, in metres, and how far beside it that is looked for.
_BEHIND_M, _BESIDE_M = (0.1, 1.0), 0.7
_PARALLEL = 0.93


@dataclass(frozen=True)
class PlaneSighting:
    """An upright plane as one frame shows it, in the map's frame.

    Lengths of its top edge are in widths of the image.

    Attributes:
        normal: [3] level unit vector, towards the camera.
        offset_m: normal . x of its points.
        span_m: where it begins and ends, along up x normal.
        heights_m: of its lowest and its highest point.
        free_top: how much of its top edge has something farther away above it.
        ceiling_top: how much of it meets a surface that faces down.
        ended_top: how much of it ends inside the image.
        cut_top: how much of it the image or missing depth cuts off.
        cells: how many lie on it.
        backed: how many lie on parallel surfaces close behind, beside or above it.
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
    backed: float


def sight(view: LevelledGrid, patch: Patch) -> PlaneSighting | None:
    """What a view says about a patch; None if it is not upright."""
    lean = float(patch.normal @ view.up_camera)
    if abs(lean) > _MOST_LEAN:
        return None
    level = patch.normal - lean * view.up_camera
    normal = view.T_map_camera[:3, :3] @ (level / np.linalg.norm(level))
    across = np.cross(view.up, normal)

    distance, along = view.along(normal), view.along(across)
    offset = float(np.median(distance[patch.cells]))
    ends = (_TAIL_PERCENT, 100.0 - _TAIL_PERCENT)
    left, right = (float(v) for v in np.percentile(along[patch.cells], ends))
    bottom, top = (float(v) for v in np.percentile(view.heights_m[patch.cells], ends))

    behind = offset - distance
    outside = (along < left) | (along > right) | (view.heights_m > top)
    near = (along > left - _BESIDE_M) & (along < right + _BESIDE_M) & (view.heights_m > bottom)
    least = _BEHIND_M[0] + 0.03 * view.grid.depth_m
    backed = view.grid.oriented & (view.facing(normal) > _PARALLEL)
    backed &= (behind > least) & (behind < _BEHIND_M[1]) & outside & near

    edge = patch.cells & (view.heights_m > top - _TOP_M)
    free, ceiling, ended, cut = _top_edge(view, patch.cells, edge, behind)
    return PlaneSighting(
        normal=normal,
        offset_m=offset,
        span_m=(left, right),
        heights_m=(bottom, top),
        free_top=free,
        ceiling_top=ceiling,
        ended_top=ended,
        cut_top=cut,
        cells=float(patch.cells.sum()),
        backed=float(backed.sum()),
    )


def _top_edge(
    view: LevelledGrid, cells: Mask, edge: Mask, behind: NDArray[np.float32]
) -> tuple[float, float, float, float]:
    """Lengths of the top edge that are free, meet a ceiling, end, and are cut off."""
    grid = view.grid
    up = view.up_camera[:2] / max(float(np.linalg.norm(view.up_camera[:2])), 1e-6)
    down_facing = view.faces(-1.0, -0.8)
    farther = behind > 0.05 + 0.015 * grid.depth_m
    open_edge, free, ceiling = np.zeros_like(cells), np.zeros_like(cells), np.zeros_like(cells)
    for step in _STEPS:
        across, down = (-round(step * float(part)) for part in up)
        own = moved(cells, down, across, False)
        if step == _STEPS[0]:
            open_edge = edge & ~own
            total = open_edge.sum()
        seen = open_edge & moved(grid.valid, down, across, False)
        free |= seen & moved(farther, down, across, False) & ~own
        ceiling |= seen & moved(down_facing & (behind < 0), down, across, False)
        open_edge &= ~seen
    # The edge is as thick as the first step.
    width = cells.shape[1] * _STEPS[0]
    cut = open_edge.sum()
    return (
        float(free.sum() / width),
        float(ceiling.sum() / width),
        float((total - cut) / width),
        float(cut / width),
    )
