"""Pixels of objects by kind, such as the name of their colour or the class of their labels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.instances.records import KeyframeMasks


class PixelCounts:
    """Number of pixels of each kind, by the number of an object.

    Args:
        kinds: number of kinds.
    """

    def __init__(self, kinds: int) -> None:
        self._kinds = kinds
        self._counts: dict[int, NDArray[np.int64]] = {}

    def add(self, record: KeyframeMasks, kinds: NDArray[np.integer]) -> None:
        """Add the kinds [h, w] of the sampled pixels of a keyframe's masks."""
        rows = len(record.objects) + 1
        cells = record.ids.astype(np.int64) * self._kinds + kinds
        counts = np.bincount(cells.reshape(-1), minlength=rows * self._kinds)
        for number, row in zip(record.objects.tolist(), counts.reshape(rows, -1)[1:], strict=True):
            if number:
                self._counts[number] = self._counts.get(number, 0) + row

    def of(self, objects: Iterable[int]) -> NDArray[np.int64]:
        """The sum [kinds] over some objects."""
        known = [self._counts[n] for n in objects if n in self._counts]
        return np.sum(known, axis=0) if known else np.zeros(self._kinds, np.int64)

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        rows = np.array(list(self._counts.values()), np.int64).reshape(-1, self._kinds)
        return {"objects": np.array(list(self._counts), np.int64), "counts": rows}

    def restore(self, arrays: Mapping[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        rows = np.array(arrays["counts"])
        self._counts = dict(zip(arrays["objects"].tolist(), rows, strict=True))
