"""Distances between objects of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit.io.occupancy import OccupancyGrid
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.paths import free_run_m

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Distance:
    """The distance between two surfaces.

    Attributes:
        distance_m: smallest distance in metres.
        nearest_m: [2, 3] the nearest point of each surface.
        centres_m: distance between the centres of both, in metres.
    """

    distance_m: float
    nearest_m: Array
    centres_m: float


def surface_distance(a_m: Array, b_m: Array) -> Distance:
    """Return the distance between two objects, given the centres [N, 3] of their Gaussians."""
    distance_m, first, second = _nearest(a_m, b_m)
    ends = np.stack([a_m[first], b_m[second]])
    middles = [(points.min(axis=0) + points.max(axis=0)) / 2 for points in (a_m, b_m)]
    return Distance(distance_m, ends, float(np.linalg.norm(middles[0] - middles[1])))


def free_width_m(
    a_m: Array, b_m: Array, ground: Ground, grid: OccupancyGrid, heights_m: tuple[float, float]
) -> float | None:
    """Return the free width of the floor between two objects, None if one is not at that height.

    It is the longest free part of the shortest horizontal line between them, so that things which
    stand between them are subtracted.

    Args:
        a_m: [N, 3] centres of the Gaussians of an object.
        b_m: [M, 3] of the other one.
        ground: plane of the floor.
        grid: grid of the floor.
        heights_m: lowest and highest height above the floor that matters: that of a robot.
    """
    low = []
    for points_m in (a_m, b_m):
        height_m = points_m @ ground.up - ground.height_m
        kept = points_m[(height_m >= heights_m[0]) & (height_m <= heights_m[1])]
        if len(kept) == 0:
            return None
        low.append(kept)
    flat = [points_m @ ground.axes[:, :2] for points_m in low]
    distance_m, first, second = _nearest(flat[0], flat[1])
    # No wider than the gap between the surfaces, which is finer than a cell.
    return min(free_run_m(grid, (low[0][first], low[1][second])), distance_m)


def _nearest(a: Array, b: Array) -> tuple[float, int, int]:
    """Distance and indices of the nearest pair of points [N, D] and [M, D]."""
    distances, index = KDTree(b).query(a)
    first = int(np.argmin(distances))
    return float(distances[first]), first, int(index[first])
