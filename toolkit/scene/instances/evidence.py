"""Evidence of whether two objects are one: how often masks covered both, or kept them apart."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Pair = tuple[int, int]

# Two objects are merged after masks covered both at least this often, and this many times as often
# as they kept them apart.
_MIN_TOGETHER, _RATIO = 3, 2
# Minimum number of frames in which masks kept a part apart from its object.
MIN_APART = 2


class PairEvidence:
    """Counts of frames for pairs of objects that were visible together.

    Args:
        connected: objects that a mask covered once are one, whatever others say: masks are
            connected surfaces, of which each view may show pieces.
    """

    def __init__(self, connected: bool = False) -> None:
        self._connected = connected
        self._counts: dict[Pair, list[int]] = {}

    def add(self, pair: Iterable[int], together: bool) -> None:
        """Count a frame in which one mask covered both objects, or different masks did."""
        a, b = pair
        counts = self._counts.setdefault((min(a, b), max(a, b)), [0, 0])
        counts[0 if together else 1] += 1

    def counts(self, a: int, b: int) -> tuple[int, int]:
        """Numbers of frames in which two objects were covered together, and apart."""
        together, apart = self._counts.get((min(a, b), max(a, b)), (0, 0))
        return together, apart

    def are_one(self, a: int, b: int) -> bool:
        """Whether the masks say that two objects are one."""
        together, apart = self.counts(a, b)
        if self._connected:
            return together > 0
        return together >= _MIN_TOGETHER and together >= _RATIO * apart

    def are_apart(self, a: int, b: int) -> bool:
        """Whether the masks say that two objects are different ones."""
        together, apart = self.counts(a, b)
        return apart >= MIN_APART and apart > together

    def replace(self, old: int, new: int) -> None:
        """Assign the evidence of an object to another one."""
        for pair in [p for p in self._counts if old in p]:
            counts = self._counts.pop(pair)
            other = pair[0] if pair[1] == old else pair[1]
            if other == new:
                continue
            key = (min(other, new), max(other, new))
            known = self._counts.setdefault(key, [0, 0])
            known[0] += counts[0]
            known[1] += counts[1]

    def state(self) -> NDArray[np.int32]:
        """Rows [P, 4] of two objects and their counts, for `restore`."""
        rows = [[*pair, *counts] for pair, counts in self._counts.items()]
        return np.array(rows, np.int32).reshape(-1, 4)

    def restore(self, rows: NDArray[np.integer]) -> None:
        """Restore an earlier `state`."""
        self._counts = {(int(a), int(b)): [int(t), int(p)] for a, b, t, p in rows}


def pairs_of(objects: Iterable[int]) -> Iterable[Pair]:
    """All pairs of different objects."""
    return combinations(sorted(set(objects)), 2)
