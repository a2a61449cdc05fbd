"""The heights of floor and ceiling, remembered."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_BIN_M = 0.025
# A level needs this share of the cells that have depth, and may have so many beyond it.
_LEAST_SHARE, _MOST_BEYOND = 0.004, 0.02
# Cells closer than this to a level belong to it.
_SAME_M = 0.10
# A level that moves by more was another one: it must be seen so often before it counts.
_CONFIRM = 3
_RATE = 0.05


class Level:
    """The lowest level surface below the camera, or by `sign` -1 the highest above.

    Heights are multiplied by the sign, so that in here a floor is looked for.

    Args:
        sign: 1 for a floor, -1 for a ceiling.
        distance_m: least and most distance from the camera.

    Attributes:
        height_m: along up in the map's frame, or None.
    """

    def __init__(self, sign: int, distance_m: tuple[float, float]) -> None:
        self._sign = sign
        self._distance_m = distance_m
        self._height = math.nan
        self._seen = 0
        self._rival = math.nan
        self._rival_seen = 0

    @property
    def height_m(self) -> float | None:
        return None if math.isnan(self._height) else self._sign * self._height

    @property
    def seen(self) -> int:
        """In how many frames it was seen at that height."""
        return self._seen

    @property
    def sure(self) -> bool:
        """Whether it was seen several times."""
        return self._seen >= _CONFIRM

    def update(
        self, heights_m: NDArray[np.floating], level: NDArray[np.bool_], camera_height_m: float
    ) -> None:
        """Take in one frame.

        Args:
            heights_m: [N] of all cells with depth, along up in the map's frame.
            level: [N], whether a cell faces up (for a ceiling, down).
            camera_height_m: in the same frame.
        """
        heights, camera = self._sign * heights_m, self._sign * camera_height_m
        if self._too_far(camera):  # the stairs were climbed
            self._height, self._seen = math.nan, 0
        found = self._lowest(heights, level, camera)
        if found is None:
            return
        if math.isnan(self._height):
            self._height, self._seen = found, 1
        elif abs(found - self._height) < _SAME_M:
            self._seen += 1
            self._height += (found - self._height) * max(1 / self._seen, _RATE)
            self._rival_seen = 0
        elif found < self._height:
            self._consider(found)

    def _consider(self, found: float) -> None:
        """A lower level than the known one, which then was a table's: believed when confirmed."""
        same = abs(found - self._rival) < _SAME_M
        self._rival_seen = self._rival_seen + 1 if same else 1
        self._rival = found
        if self._rival_seen >= _CONFIRM or self._seen < _CONFIRM:
            self._height, self._seen, self._rival_seen = found, 1, 0

    def _lowest(
        self, heights: NDArray[np.floating], level: NDArray[np.bool_], camera: float
    ) -> float | None:
        """The lowest level that has enough cells and hardly any below it."""
        nearest, farthest = self._distance_m
        below = camera - heights
        wanted = level & (below > nearest) & (below < farthest)
        least = _LEAST_SHARE * len(heights)
        if wanted.sum() < max(least, 1):
            return None
        first = camera - farthest
        bins = ((heights[wanted] - first) / _BIN_M).astype(np.int64)
        counts = np.bincount(bins, minlength=4)
        # Three bins together: a level on the border of two is no less a level.
        smooth = np.convolve(counts, np.ones(3, np.int64), mode="same")
        peaks = np.flatnonzero(smooth >= max(least, 0.05 * smooth.max()))
        if not len(peaks):
            return None
        start = first + _BIN_M * (peaks[0] + 0.5)
        near = wanted & (np.abs(heights - start) < _SAME_M)
        found = float(np.median(heights[near]))
        beyond = np.mean(heights < found - _SAME_M)
        return found if beyond < _MOST_BEYOND else None

    def _too_far(self, camera: float) -> bool:
        return not math.isnan(self._height) and camera - self._height > self._distance_m[1]

    def state(self) -> NDArray[np.float64]:
        """Numbers that `restore` takes."""
        return np.array([self._height, self._seen, self._rival, self._rival_seen])

    def restore(self, numbers: NDArray[np.float64]) -> None:
        """Take over an earlier `state`."""
        self._height, self._rival = float(numbers[0]), float(numbers[2])
        self._seen, self._rival_seen = int(numbers[1]), int(numbers[3])
