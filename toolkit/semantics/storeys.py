"""Storeys: levels of the floor, one above the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Floors whose heights differ by less belong to one storey: steps, ramps and platforms.
_MIN_STOREY_M = 1.8
_BIN_M = 0.1
# A level has at least this share of the largest level's points.
_MIN_SHARE = 0.1
# Objects stand up to this much below the height of their floor.
_BELOW_M = 0.4


@dataclass(frozen=True)
class Storeys:
    """Heights of storeys along the vertical in metres, ascending; at least one."""

    heights_m: Sequence[float]

    def __len__(self) -> int:
        """Number of storeys."""
        return len(self.heights_m)

    def of(self, bottom_m: float) -> int:
        """Return the index of the storey of an object by its lowest height."""
        return max(int(np.searchsorted(self.heights_m, bottom_m + _BELOW_M)) - 1, 0)


def find_storeys(floor_m: NDArray[np.float64], default_m: float) -> Storeys:
    """Return the storeys of a map.

    Args:
        floor_m: [N] heights of points of floors.
        default_m: height of the only storey without such points.
    """
    if len(floor_m) == 0:
        return Storeys([default_m])
    bins = np.floor((floor_m - floor_m.min()) / _BIN_M).astype(int)
    counts = np.convolve(np.bincount(bins), np.ones(3), mode="same")
    found: list[int] = []
    for level in np.argsort(-counts, kind="stable").tolist():
        if counts[level] < _MIN_SHARE * counts.max():
            break
        if all(abs(level - other) * _BIN_M >= _MIN_STOREY_M for other in found):
            found.append(level)
    heights_m = [float(np.median(floor_m[np.abs(bins - level) <= 1])) for level in sorted(found)]
    return Storeys(heights_m)
