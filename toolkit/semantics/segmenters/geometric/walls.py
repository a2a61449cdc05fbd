"""Upright planes and which of them are walls: remembered, since one view rarely shows it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.segmenters.geometric.wall_evidence import PlaneSighting

Array = NDArray[np.float64]

# Planes are the same if they differ by less than this, and their spans meet within the gap.
_SAME_COSINE, _SAME_OFFSET_M, _SAME_GAP_M = math.cos(math.radians(10.0)), 0.07, 0.4
_MOST_PLANES = 100
# Share of a new sighting in a plane's position; what older sightings still count.
_RATE, _KEEP = 0.1, 0.95
# A plane that turns out higher than this had another top edge than was thought.
_HIGHER_M = 0.15
# Log-odds beyond which a plane changes its mind.
_HYSTERESIS = 0.5
# Nothing smaller is taken for a wall without further reason.
_WALL_AREA_M2 = 0.35
_FURNITURE_HEIGHT_M, _WALL_HEIGHT_M = 1.3, 2.2
_AT_CEILING_M = 0.15
# So much of a top edge, in widths of the image, tells all that it can.
_TELLING_EDGE = 0.04

# Columns of the table.
_NORMAL, _OFFSET, _SPAN, _HEIGHTS = slice(0, 3), 3, slice(4, 6), slice(6, 8)
_TOPS, _CELLS, _BACKED, _SEEN, _WALL = slice(8, 12), 12, 13, 14, 15
_EVIDENCE = slice(8, 14)
_FREE, _CEILING, _ENDED, _CUT = range(8, 12)
_COLUMNS = 16


@dataclass(frozen=True)
class Wall:
    """A remembered wall, in the map's frame; attributes as in `PlaneSighting`."""

    normal: Array
    offset_m: float
    span_m: tuple[float, float]


class WallMemory:
    """The upright planes seen so far, each with what speaks for and against a wall."""

    def __init__(self) -> None:
        self._table = np.zeros((0, _COLUMNS))

    def update(
        self, sightings: list[PlaneSighting], floor_m: float | None, ceiling_m: float | None
    ) -> None:
        """Take in the upright planes of one frame; heights of floor and ceiling if known."""
        for plane in sightings:
            same = self._match(plane)
            if same is None:
                self._add(plane)
            else:
                self._merge(self._table[same], plane)
        for row in self._table:
            odds = _log_odds(row, floor_m, ceiling_m)
            # What was seen once has no habit yet.
            bound = _HYSTERESIS if row[_SEEN] > 1 else 0.0
            row[_WALL] = odds > (-bound if row[_WALL] else bound)

    def walls(self) -> list[Wall]:
        """Those that are walls."""
        return [
            Wall(row[_NORMAL].copy(), float(row[_OFFSET]), tuple(row[_SPAN].tolist()))
            for row in self._table
            if row[_WALL]
        ]

    def _match(self, plane: PlaneSighting) -> int | None:
        """The row of the same plane; of several, the one that shares most of the span."""
        table = self._table
        left, right = table[:, _SPAN].T
        shared = np.minimum(right, plane.span_m[1]) - np.maximum(left, plane.span_m[0])
        same = table[:, _NORMAL] @ plane.normal > _SAME_COSINE
        same &= np.abs(table[:, _OFFSET] - plane.offset_m) < _SAME_OFFSET_M
        same &= shared > -_SAME_GAP_M
        return int(np.argmax(np.where(same, shared, -np.inf))) if same.any() else None

    def _add(self, plane: PlaneSighting) -> None:
        self._table = np.vstack([self._table, _row(plane)])
        if len(self._table) > _MOST_PLANES:
            rarest = int(np.argmin(self._table[:-1, _SEEN]))
            self._table = np.delete(self._table, rarest, axis=0)

    @staticmethod
    def _merge(row: Array, plane: PlaneSighting) -> None:
        """Take a sighting into the row of its plane, in place."""
        new = _row(plane)
        highest = row[_HEIGHTS][1]
        if plane.heights_m[1] > highest + _HIGHER_M:
            row[_TOPS] = 0.0
        elif plane.heights_m[1] < highest - _HIGHER_M:
            new[_TOPS] = 0.0
        row[_SEEN] += 1
        rate = max(_RATE, 1 / row[_SEEN])
        normal = row[_NORMAL] + rate * (plane.normal - row[_NORMAL])
        row[_NORMAL] = normal / np.linalg.norm(normal)
        row[_OFFSET] += rate * (plane.offset_m - row[_OFFSET])
        for ends in (_SPAN, _HEIGHTS):
            low, high = row[ends]
            row[ends] = min(low, new[ends][0]), max(high, new[ends][1])
        row[_EVIDENCE] = _KEEP * row[_EVIDENCE] + new[_EVIDENCE]

    def state(self) -> Array:
        """The table that `restore` takes."""
        return self._table.copy()

    def restore(self, table: Array) -> None:
        """Take over an earlier `state`."""
        self._table = np.array(table, dtype=np.float64).reshape(-1, _COLUMNS)


def _row(plane: PlaneSighting) -> Array:
    tops = (plane.free_top, plane.ceiling_top, plane.ended_top, plane.cut_top)
    return np.array(
        [
            *plane.normal, plane.offset_m, *plane.span_m, *plane.heights_m,
            *tops, plane.cells, plane.backed, 1.0, 0.0,
        ]
    )  # fmt: skip


def _log_odds(row: Array, floor_m: float | None, ceiling_m: float | None) -> float:
    """What is known of a plane, weighed: above 0 it is rather a wall.

    The weights were chosen by eye and by the scores of `benchmarks/segmenters.py`.
    """
    (left, right), (bottom, top) = row[_SPAN], row[_HEIGHTS]
    area_m2 = max((right - left) * (top - bottom), 1e-6)
    odds = float(np.clip(math.log(area_m2 / _WALL_AREA_M2), -2.0, 1.0))

    # A little of an edge that is mostly cut off, or mostly not free, may be noise.
    known = row[_ENDED] + 0.5 * row[_CUT]
    free = row[_FREE] / known if known > 0 else 0.0
    odds -= 4.0 * min(1.0, known / _TELLING_EDGE) * max(free - 0.25, 0.0)
    odds += 1.5 * min(1.0, row[_CEILING] / _TELLING_EDGE)
    backed = row[_BACKED] / (row[_BACKED] + row[_CELLS])
    odds -= 2.5 * float(np.clip((backed - 0.03) / 0.2, 0.0, 1.0))

    if ceiling_m is not None and top > ceiling_m - _AT_CEILING_M:
        odds += 2.5
    if floor_m is not None:
        reach = top - floor_m
        if reach > _WALL_HEIGHT_M:
            odds += 1.0
        if reach < _FURNITURE_HEIGHT_M:
            odds -= 2.5 * row[_ENDED] / (row[_ENDED] + row[_CUT] + 0.01)
    return odds
