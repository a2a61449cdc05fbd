"""Shortest free paths on the occupancy grid of a map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from toolkit.base.errors import ToolkitError
from toolkit.io.occupancy import FREE, OccupancyGrid

Array = NDArray[np.float64]
Cells = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Maximum gap between the body and an object that it stands at, or a given position.
_REACH_M = 0.6
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))


class NoPathError(ToolkitError):
    """There is no free path; the message says how wide a path is."""


@dataclass(frozen=True)
class Place:
    """An end of a path.

    Attributes:
        name: for messages.
        footprint: [H, W] cells of the object or position on the grid.
        within: [H, W] cells from which it is reached, for instance those of its room; None for all.
        storey: index of the storey whose grid this is.
    """

    name: str
    footprint: Mask
    within: Mask | None = None
    storey: int = 0


@dataclass(frozen=True)
class FreePath:
    """A free path over the floor.

    Attributes:
        points_m: [P, 3] way points on the floor in the frame of the map, in metres.
        length_m: length in metres.
        width_m: smallest free width on the way in metres.
        narrowest_m: [3] the way's narrowest place.
        cells: [n, 2] all cells on the way, from start to goal.
    """

    points_m: Array
    length_m: float
    width_m: float
    narrowest_m: Array
    cells: Cells


class PathFinder:
    """Paths on a grid; unknown cells are not free.

    Args:
        grid: the grid.
    """

    def __init__(self, grid: OccupancyGrid) -> None:
        self._grid = grid
        free = np.pad((grid.cells == FREE).astype(np.uint8), 1)
        distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
        # Distances are between centres: a passage of n cells is n cells wide.
        self._width_m = np.maximum(2.0 * distance - 1.0, 0.0) * grid.cell_m

    def shortest(self, start: Place, goal: Place, width_m: float) -> FreePath:
        """Return the shortest path of a minimum free width; it ends beside objects.

        Raises:
            NoPathError: there is none; the message contains the width that is free.
        """
        for place in (start, goal):
            self._check_reach(place, width_m)
        ends = self._ends(start, goal, width_m)
        if ends is None:
            raise NoPathError(self._narrow(start, goal, width_m))
        wide = self._wide(width_m)
        number = np.cumsum(wide).reshape(wide.shape) - 1
        distance, previous = self._distances(wide, number, number[ends[0]])
        goals = number[ends[1]]
        end = int(goals[distance[goals].argmin()])
        nodes = [end]
        while previous[nodes[-1]] >= 0:
            nodes.append(int(previous[nodes[-1]]))
        cells = np.argwhere(wide)[nodes[::-1]]
        return self._path(self._straightened(cells, wide))

    def widest(self, start: Place, goal: Place) -> tuple[float, Array] | None:
        """Return the largest free width of any path and its narrowest place [3], None for none."""
        low, best = 0, None
        widths = np.unique(self._width_m[self._width_m > 0])
        high = len(widths) - 1
        while low <= high:
            middle = (low + high) // 2
            if self._ends(start, goal, float(widths[middle])) is not None:
                best, low = middle, middle + 1
            else:
                high = middle - 1
        if best is None:
            return None
        path = self.shortest(start, goal, float(widths[best]))
        return float(widths[best]), path.narrowest_m

    def _wide(self, width_m: float) -> Mask:
        # Occupied and unknown cells have a width of 0, which no tolerance may admit.
        return np.asarray((self._width_m > 0) & (self._width_m >= width_m - 1e-9))

    def _check_reach(self, place: Place, width_m: float) -> None:
        if (self._wide(width_m) & self._near(place, width_m)).any():
            return
        free_m = float(self._width_m[self._near(place, width_m)].max(initial=0.0))
        if free_m <= 0:
            raise NoPathError(
                f"no free floor was observed within {_REACH_M:g} m of {place.name}; choose another "
                "place, or record the floor there"
            )
        raise NoPathError(
            f"no floor {width_m:g} m wide is free at {place.name}; {free_m:.2f} m is free there: "
            "give a smaller width"
        )

    def _near(self, place: Place, width_m: float) -> Mask:
        """Return the cells from which a body of some width reaches a place."""
        near = _distance(place.footprint) * self._grid.cell_m <= _REACH_M + width_m / 2
        return near if place.within is None else near & place.within

    def _ends(self, start: Place, goal: Place, width_m: float) -> tuple[Mask, Mask] | None:
        """Return the cells [H, W] at which a path of some width begins and ends, None for no path.

        They are the nearest ones to both places that are connected with each other.
        """
        wide = self._wide(width_m)
        _, pieces = cv2.connectedComponents(wide.astype(np.uint8), connectivity=8)
        near = [wide & self._near(place, width_m) for place in (start, goal)]
        gaps = [_distance(place.footprint) for place in (start, goal)]
        sums = {
            int(piece): sum(
                float(gap[mask & (pieces == piece)].min())
                for gap, mask in zip(gaps, near, strict=True)
            )
            for piece in np.intersect1d(pieces[near[0]], pieces[near[1]])
        }
        if not sums:
            return None
        same = pieces == min(sums, key=lambda piece: sums[piece])
        first, last = (
            mask & same & (gap <= gap[mask & same].min() + 1.0)
            for gap, mask in zip(gaps, near, strict=True)
        )
        return first, last

    def _distances(
        self, wide: Mask, number: Cells, starts: Cells
    ) -> tuple[Array, NDArray[np.int32]]:
        """Return distance and previous node of the cells of some width."""
        sources, targets, lengths = [], [], []
        rows, columns = wide.shape
        for down, right in _STEPS:
            here = (slice(0, rows - down), slice(max(0, -right), columns - max(0, right)))
            there = (slice(down, rows), slice(max(0, right), columns + min(0, right)))
            both = wide[here] & wide[there]
            sources.append(number[here][both])
            targets.append(number[there][both])
            lengths.append(np.full(int(both.sum()), np.hypot(down, right)))
        values = np.concatenate(lengths), (np.concatenate(sources), np.concatenate(targets))
        graph = coo_array(values, shape=(int(wide.sum()),) * 2).tocsr()
        distance, previous, _ = dijkstra(
            graph, directed=False, indices=starts, return_predecessors=True, min_only=True
        )
        return distance, previous

    def _straightened(self, cells: Cells, wide: Mask) -> Cells:
        """Return the corners of a path: each is the farthest one in sight of the one before."""
        kept, last = [0], len(cells) - 1
        while kept[-1] < last:
            start = kept[-1]
            low, high = start + 1, last
            # Sight usually ends once along a path, so the farthest cell is found by bisection.
            while low < high:
                middle = (low + high + 1) // 2
                if _in_sight(cells[start], cells[middle], wide):
                    low = middle
                else:
                    high = middle - 1
            kept.append(low)
        return cells[kept]

    def _path(self, corners: Cells) -> FreePath:
        points_m = self._grid.points_of(corners)
        along = np.concatenate([corners[:1], *(_line(a, b) for a, b in pairwise(corners))])
        widths = self._width_m[tuple(along.T)]
        narrowest = along[[int(widths.argmin())]]
        steps = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
        narrowest_m = self._grid.points_of(narrowest)[0]
        return FreePath(points_m, float(steps.sum()), float(widths.min()), narrowest_m, along)

    def _narrow(self, start: Place, goal: Place, width_m: float) -> str:
        """Return the message where no path of some width exists."""
        ends = f"from {start.name} to {goal.name}"
        found = self.widest(start, goal)
        if found is None:
            return (
                f"no free path {ends}: observed floor does not connect them; a door may be closed, "
                "or the floor between them was not recorded"
            )
        x, y, z = found[1]
        return (
            f"no path {width_m:g} m wide {ends}; {found[0]:.2f} m is free, narrowest at "
            f"({x:.2f}, {y:.2f}, {z:.2f}): give a smaller width"
        )


def _distance(mask: Mask) -> NDArray[np.float32]:
    """Return the distance [H, W] of cells to the nearest cell of a mask, in cells."""
    outside = (~mask).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))


def _line(a: Cells, b: Cells) -> Cells:
    """Return the cells on the way from one to another, without the first."""
    count = int(2 * np.abs(b - a).max()) + 1
    share = np.linspace(0.0, 1.0, count + 1)[1:, None]
    return np.rint(a + share * (b - a)).astype(np.intp)


def _in_sight(a: Cells, b: Cells, wide: Mask) -> bool:
    return bool(wide[tuple(_line(a, b).T)].all())


def free_run_m(grid: OccupancyGrid, ends_m: Iterable[Array]) -> float:
    """Return the longest free part of the straight line between two points of the map, in metres.

    Args:
        grid: the grid.
        ends_m: two points [3].
    """
    a, b = grid.cells_of(np.stack(list(ends_m)))
    cells = np.concatenate([a[None], _line(a, b)])
    free = np.concatenate([[False], grid.cells[tuple(cells.T)] == FREE, [False]])
    edges = np.flatnonzero(np.diff(free.astype(np.int8)))
    if len(edges) == 0:
        return 0.0
    runs = edges[1::2] - edges[::2]
    length = float(np.linalg.norm(b - a)) * grid.cell_m
    return float(runs.max()) / len(cells) * (length + grid.cell_m)
