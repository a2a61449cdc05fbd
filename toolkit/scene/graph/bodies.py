"""Points of an object above the floor, and how two such bodies touch, support and contain."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit.base.geometry.thinning import thinned

Array = NDArray[np.float64]
Keys = NDArray[np.int64]

# Cell of the comparison of footprints; larger than the spacing of Gaussians.
_CELL_M = 0.05
# Minimum share of the footprint of an object above another one, and of its edge on that one.
_MIN_SUPPORT = 0.3
# The lowest and highest parts of an object are these percentiles of the heights of its points,
# because single Gaussians with wrong labels may lie beyond.
_BOTTOM_PERCENT, _TOP_PERCENT = 2.0, 98.0
# Minimum share of the points of an object inside the box of its container.
_MIN_INSIDE = 0.8
# A container surrounds an object in at least this many of 16 horizontal directions, or has surface
# above and below this share of its footprint.
_SECTORS, _MIN_SECTORS, _MIN_BETWEEN = 16, 12, 0.5
# What a body hides from the camera is this many cells beside what the camera sees.
_HIDDEN_CELLS = 2
# What hangs at a wall has this share of its points at most this far from it; few points suffice.
_MIN_HANGING, _HANGING_M, _SAMPLES = 0.5, 0.15, 200
# Every n-th point is compared first with those of another body.
_NEAR_STEP = 16
# Objects with a smaller gap to the one below stand on something that no camera has seen.
_MIN_GAP_M = 0.2


class Body:
    """An object along the axes of the floor.

    Args:
        points: [N, 3] its points, N >= 1; the third coordinate is the height.

    Attributes:
        points: as given.
        bottom: height of its lowest part.
        top: height of its highest part.
        low, high: [3] corners of the box around all points.
    """

    def __init__(self, points: Array) -> None:
        self.points = points
        # A tenth of the time of percentiles, minimum and maximum of as many points.
        ordered = np.sort(points, axis=0)
        self.low, self.high = ordered[0], ordered[-1]
        self.bottom = _percentile(ordered[:, 2], _BOTTOM_PERCENT)
        self.top = _percentile(ordered[:, 2], _TOP_PERCENT)

    @cached_property
    def cells(self) -> Keys:
        """The cells of its footprint, ascending."""
        return _cells(self.points)

    @cached_property
    def _rim(self) -> Keys:
        """The cells at the edge of the footprint: what is below the others is hidden from above."""
        sides = [step << shift for step in (-_HIDDEN_CELLS, _HIDDEN_CELLS) for shift in (0, 32)]
        inner = np.all([_contained(self.cells + side, self.cells) for side in sides], axis=0)
        return np.asarray(self.cells[~inner])

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)

    def on(self, other: Body, contact_m: float) -> bool:
        """Return whether enough of the edge has points of `other` right below the bottom.

        What supports an object begins below it: neighbours on one table do not support each other.
        """
        return self.support(other, contact_m) >= _MIN_SUPPORT

    def support(self, other: Body, contact_m: float) -> float:
        """Return the share of the edge of the footprint that `other` supports."""
        if other.bottom > self.bottom - contact_m / 2 or other.inside(self):
            return 0.0
        # What the object hides was not observed, so its surroundings support it as well.
        return self._share(self._rim, self._support(other, contact_m), 1)

    def reaches(self, floor: Body, contact_m: float) -> bool:
        """Return whether a floor has points at the height of the bottom below or beside it.

        Furniture hides the floor below it, so that only its surroundings are known.
        """
        around = _grown(self.cells, _HIDDEN_CELLS)
        return bool(_contained(self._support(floor, contact_m), around).any())

    def points_beside(self, other: Body, margin_m: float) -> Array:
        """Return the points [n, 3] in the box of another body, enlarged by a margin."""
        low, high = other.low - margin_m, other.high + margin_m
        return self.points[((self.points >= low) & (self.points <= high)).all(axis=1)]

    def hangs_at(self, wall: Body) -> bool:
        """Return whether most points are close to a wall: a picture, but not a cupboard."""
        if self.far(wall, _HANGING_M):
            return False
        points = thinned(self.points, _SAMPLES)
        found, _ = wall._tree.query(points, distance_upper_bound=_HANGING_M)
        return float(np.isfinite(found).mean()) >= _MIN_HANGING

    def _support(self, other: Body, contact_m: float) -> Keys:
        """Return the cells in which the other has points at the height of the bottom."""
        near = other.points[other._within_sides(self, _HIDDEN_CELLS * _CELL_M)]
        low, high = self.bottom - contact_m, self.bottom + contact_m / 2
        return _cells(near[(near[:, 2] >= low) & (near[:, 2] <= high)])

    def within(self, other: Body) -> bool:
        """Return whether `other` surrounds this object, or encloses it from above and below."""
        if ((self.low + self.high) / 2 < other.low).any() or (self.low > other.high).any():
            return False
        return self.inside(other) and (self._between(other) or self._surrounded(other))

    def inside(self, other: Body) -> bool:
        """Return whether most of this object is in the box of another one."""
        inside = ((self.points >= other.low) & (self.points <= other.high)).all(axis=1)
        return float(inside.mean()) >= _MIN_INSIDE

    def _surrounded(self, other: Body) -> bool:
        # A plate surrounds what lies on it up to its rim, but does not contain it.
        heights, middle = other.points[:, 2], (self.bottom + self.top) / 2
        beside = other.points[(heights >= middle) & (heights <= self.high[2])]
        offset = beside[:, :2] - self.points[:, :2].mean(axis=0)
        angles = np.arctan2(offset[:, 1], offset[:, 0])
        sectors = np.floor((angles + np.pi) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
        return len(np.unique(sectors)) >= _MIN_SECTORS

    def _between(self, other: Body) -> bool:
        """Return whether the other has surface above and below: boards of a shelf.

        The back of a shelf is hidden by what it contains, so that the horizontal directions
        cannot tell.
        """
        near = other.points[other._within_sides(self, _HIDDEN_CELLS * _CELL_M)]
        return all(
            self._share(self.cells, _cells(part), _HIDDEN_CELLS) >= _MIN_BETWEEN
            for part in (near[near[:, 2] >= self.top], near[near[:, 2] <= self.bottom])
        )

    def above(self, other: Body) -> bool:
        """Return whether enough of the footprint lies over the other, with a gap between them."""
        if self.bottom - other.top < _MIN_GAP_M or self._apart(other):
            return False
        # What hangs at a wall is above the furniture at this wall, which does not touch it.
        return self._share(self.cells, other.cells, _HIDDEN_CELLS) >= _MIN_SUPPORT

    def near(self, other: Body, distance_m: float) -> bool:
        """Return whether two points of the bodies are at most this far from each other."""
        if self.far(other, distance_m):
            return False
        # Many objects are near a wall: one tree serves all of them.
        small, large = sorted((self, other), key=lambda body: len(body.points))
        points = small.points_beside(large, distance_m)
        # Few points suffice to find that bodies are near; all are needed to find that they are not.
        for some in (points[::_NEAR_STEP], points):
            found, _ = large._tree.query(some, distance_upper_bound=distance_m)
            if np.isfinite(found).any():
                return True
        return False

    def far(self, other: Body, distance_m: float) -> bool:
        """Return whether the boxes are farther from each other than a distance."""
        gap = np.maximum(self.low - other.high, other.low - self.high)
        return bool((gap > distance_m).any())

    def _apart(self, other: Body) -> bool:
        """Return whether the boxes of the footprints are apart."""
        gap = np.maximum(self.low - other.high, other.low - self.high)
        return bool((gap[:2] > _HIDDEN_CELLS * _CELL_M).any())

    def _within_sides(self, other: Body, margin_m: float) -> NDArray[np.bool_]:
        """Return which points [N] are above, in or below the box of another body."""
        flat = self.points[:, :2]
        low, high = other.low[:2] - margin_m, other.high[:2] + margin_m
        return ((flat >= low) & (flat <= high)).all(axis=1)

    @staticmethod
    def _share(cells: Keys, others: Keys, grown: int) -> float:
        """Return the share of cells that are at most some cells from one of the others."""
        return float(_contained(cells, _grown(others, grown)).mean())


def _percentile(ordered: Array, percent: float) -> float:
    """Return a percentile of ascending values, linear between them."""
    place = percent / 100.0 * (len(ordered) - 1)
    low, high = ordered[int(place)], ordered[min(int(place) + 1, len(ordered) - 1)]
    return float(low + (high - low) * (place - int(place)))


def _cells(points: Array) -> Keys:
    """Return the keys of the cells of points [N, 3], ascending."""
    steps = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    return np.unique((steps[:, 0] << 32) + steps[:, 1])


def _grown(cells: Keys, steps: int) -> Keys:
    span = np.arange(-steps, steps + 1, dtype=np.int64)
    offsets = ((span[:, None] << 32) + span[None]).reshape(-1)
    return np.unique((cells[:, None] + offsets).reshape(-1))


def _contained(cells: Keys, others: Keys) -> NDArray[np.bool_]:
    """Return which cells are among others, which are ascending."""
    if len(others) == 0:
        return np.zeros(len(cells), bool)
    places = np.minimum(np.searchsorted(others, cells), len(others) - 1)
    return np.asarray(others[places] == cells)
