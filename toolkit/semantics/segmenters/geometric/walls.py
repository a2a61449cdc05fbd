"""Vertical planes accumulated over frames, and their classification as walls."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.segmenters.geometric.wall_evidence import PlaneObservation

Array = NDArray[np.float64]

# Two observations are of the same plane within these bounds on the angle and the offset, and on the
# gap between their spans.
_SAME_COSINE, _SAME_OFFSET_M, _SAME_GAP_M = math.cos(math.radians(10.0)), 0.07, 0.4
_MAX_PLANES = 100
# Minimum weight of a new observation in a plane's position; decay of earlier evidence per frame.
_RATE, _KEEP = 0.1, 0.95
# If the top of a plane changes by more than this, earlier evidence of its top edge is discarded.
_HIGHER_M = 0.15
# Absolute log-odds required to change the classification of a plane.
_HYSTERESIS = 0.5
# Area at which the log-odds are neutral.
_WALL_AREA_M2 = 0.35
_FURNITURE_HEIGHT_M, _WALL_HEIGHT_M = 1.3, 2.2
_AT_CEILING_M = 0.15
# Length of the top edge, in image widths, at which its evidence has full weight.
_FULL_WEIGHT_EDGE = 0.04

# Columns of the table.
_NORMAL, _OFFSET, _SPAN, _HEIGHTS = slice(0, 3), 3, slice(4, 6), slice(6, 8)
_TOPS, _CELLS, _BEHIND, _SEEN, _WALL = slice(8, 12), 12, 13, 14, 15
_EVIDENCE = slice(8, 14)
_FREE, _CEILING, _ENDED, _CUT = range(8, 12)
_COLUMNS = 16


@dataclass(frozen=True)
class Wall:
    """A wall in the map frame; attributes as in `PlaneObservation`."""

    normal: Array
    offset_m: float
    span_m: tuple[float, float]


class WallMemory:
    """The vertical planes observed so far, each with the evidence for and against a wall."""

    def __init__(self) -> None:
        self._table = np.zeros((0, _COLUMNS))

    def update(
        self, observations: list[PlaneObservation], floor_m: float | None, ceiling_m: float | None
    ) -> None:
        """Integrate the vertical planes of one frame.

        Args:
            observations: vertical planes of the frame.
            floor_m: height of the floor, if known.
            ceiling_m: height of the ceiling, if known.
        """
        for plane in observations:
            same = self._match(plane)
            if same is None:
                self._add(plane)
            else:
                self._merge(self._table[same], plane)
        for row in self._table:
            odds = _log_odds(row, floor_m, ceiling_m)
            # No hysteresis after a single observation.
            bound = _HYSTERESIS if row[_SEEN] > 1 else 0.0
            row[_WALL] = odds > (-bound if row[_WALL] else bound)

    def walls(self) -> list[Wall]:
        """Return the planes classified as walls."""
        return [
            Wall(row[_NORMAL].copy(), float(row[_OFFSET]), tuple(row[_SPAN].tolist()))
            for row in self._table
            if row[_WALL]
        ]

    def _match(self, plane: PlaneObservation) -> int | None:
        """Return the row of the same plane; of several, the one with the largest span overlap."""
        table = self._table
        left, right = table[:, _SPAN].T
        overlap = np.minimum(right, plane.span_m[1]) - np.maximum(left, plane.span_m[0])
        same = table[:, _NORMAL] @ plane.normal > _SAME_COSINE
        same &= np.abs(table[:, _OFFSET] - plane.offset_m) < _SAME_OFFSET_M
        same &= overlap > -_SAME_GAP_M
        return int(np.argmax(np.where(same, overlap, -np.inf))) if same.any() else None

    def _add(self, plane: PlaneObservation) -> None:
        self._table = np.vstack([self._table, _row(plane)])
        if len(self._table) > _MAX_PLANES:
            rarest = int(np.argmin(self._table[:-1, _SEEN]))
            self._table = np.delete(self._table, rarest, axis=0)

    @staticmethod
    def _merge(row: Array, plane: PlaneObservation) -> None:
        """Merge an observation into the row of its plane in place."""
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
        """Return the table that `restore` accepts."""
        return self._table.copy()

    def restore(self, table: Array) -> None:
        """Restore an earlier `state`."""
        self._table = np.array(table, dtype=np.float64).reshape(-1, _COLUMNS)


def _row(plane: PlaneObservation) -> Array:
    tops = (plane.free_top, plane.ceiling_top, plane.ended_top, plane.cut_top)
    return np.array(
        [
            *plane.normal, plane.offset_m, *plane.span_m, *plane.heights_m,
            *tops, plane.cells, plane.cells_behind, 1.0, 0.0,
        ]
    )  # fmt: skip


def _log_odds(row: Array, floor_m: float | None, ceiling_m: float | None) -> float:
    """Return the log-odds that a plane is a wall.

    The weights were chosen manually.
    """
    (left, right), (bottom, top) = row[_SPAN], row[_HEIGHTS]
    area_m2 = max((right - left) * (top - bottom), 1e-6)
    odds = float(np.clip(math.log(area_m2 / _WALL_AREA_M2), -2.0, 1.0))

    # Short observed edges and small free fractions may be noise.
    known = row[_ENDED] + 0.5 * row[_CUT]
    free = row[_FREE] / known if known > 0 else 0.0
    odds -= 4.0 * min(1.0, known / _FULL_WEIGHT_EDGE) * max(free - 0.25, 0.0)
    odds += 1.5 * min(1.0, row[_CEILING] / _FULL_WEIGHT_EDGE)
    behind = row[_BEHIND] / (row[_BEHIND] + row[_CELLS])
    odds -= 2.5 * float(np.clip((behind - 0.03) / 0.2, 0.0, 1.0))

    if ceiling_m is not None and top > ceiling_m - _AT_CEILING_M:
        odds += 2.5
    if floor_m is not None:
        reach = top - floor_m
        if reach > _WALL_HEIGHT_M:
            odds += 1.0
        if reach < _FURNITURE_HEIGHT_M:
            odds -= 2.5 * row[_ENDED] / (row[_ENDED] + row[_CUT] + 0.01)
    return odds
