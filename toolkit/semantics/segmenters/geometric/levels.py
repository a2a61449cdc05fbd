"""Heights of floor and ceiling, estimated over frames."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_BIN_M = 0.025
# Minimum fraction of the cells with depth on a level, and maximum fraction beyond it.
_MIN_FRACTION, _MAX_BEYOND = 0.004, 0.02
# Maximum distance of cells from their level.
_SAME_M = 0.10
# Number of observations after which a different level replaces the current one.
_CONFIRM = 3
_RATE = 0.05


class Level:
    """The lowest horizontal surface below the camera, or with `sign` -1 the highest one above it.

    Heights are multiplied by the sign internally, so that a ceiling is processed like a floor.

    Args:
        sign: 1 for a floor, -1 for a ceiling.
        distance_m: minimum and maximum distance from the camera.

    Attributes:
        height_m: height along up in the map frame, or None.
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
        """Number of frames with an observation at this height."""
        return self._seen

    @property
    def sure(self) -> bool:
        """Whether the level is confirmed by several observations."""
        return self._seen >= _CONFIRM

    def update(
        self, heights_m: NDArray[np.floating], level: NDArray[np.bool_], camera_height_m: float
    ) -> None:
        """Integrate one frame.

        Args:
            heights_m: [N] heights of all cells with depth, along up in the map frame.
            level: [N], whether a cell faces up (for a ceiling, down).
            camera_height_m: height of the camera in the same frame.
        """
        heights, camera = self._sign * heights_m, self._sign * camera_height_m
        if self._too_far(camera):  # the camera moved to another storey
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
        """Replace the level by a lower one once this is confirmed, for instance table by floor."""
        same = abs(found - self._rival) < _SAME_M
        self._rival_seen = self._rival_seen + 1 if same else 1
        self._rival = found
        if self._rival_seen >= _CONFIRM or self._seen < _CONFIRM:
            self._height, self._seen, self._rival_seen = found, 1, 0

    def _lowest(
        self, heights: NDArray[np.floating], level: NDArray[np.bool_], camera: float
    ) -> float | None:
        """Return the lowest level with enough cells on it and hardly any below it."""
        nearest, farthest = self._distance_m
        below = camera - heights
        candidates = level & (below > nearest) & (below < farthest)
        min_count = _MIN_FRACTION * len(heights)
        if candidates.sum() < max(min_count, 1):
            return None
        first = camera - farthest
        bins = ((heights[candidates] - first) / _BIN_M).astype(np.int64)
        counts = np.bincount(bins, minlength=4)
        # Sum three bins, because a level can be at the border between two.
        smooth = np.convolve(counts, np.ones(3, np.int64), mode="same")
        peaks = np.flatnonzero(smooth >= max(min_count, 0.05 * smooth.max()))
        if not len(peaks):
            return None
        start = first + _BIN_M * (peaks[0] + 0.5)
        near = candidates & (np.abs(heights - start) < _SAME_M)
        found = float(np.median(heights[near]))
        beyond = np.mean(heights < found - _SAME_M)
        return found if beyond < _MAX_BEYOND else None

    def _too_far(self, camera: float) -> bool:
        return not math.isnan(self._height) and camera - self._height > self._distance_m[1]

    def state(self) -> NDArray[np.float64]:
        """Return the values that `restore` accepts."""
        return np.array([self._height, self._seen, self._rival, self._rival_seen])

    def restore(self, numbers: NDArray[np.float64]) -> None:
        """Restore an earlier `state`."""
        self._height, self._rival = float(numbers[0]), float(numbers[2])
        self._seen, self._rival_seen = int(numbers[1]), int(numbers[3])
