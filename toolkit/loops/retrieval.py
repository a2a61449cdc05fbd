"""The keyframes whose descriptors are nearest: FAISS's one door."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DependencyError

_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Neighbour:
    """A keyframe near a query.

    Attributes:
        keyframe: its number, in the order of adding.
        distance: Euclidean, in [0, 2]; FAISS's own is the square of it.
        cosine: of the angle between the two descriptors, 1 - distance^2 / 2.
    """

    keyframe: int
    distance: float
    cosine: float


class DescriptorIndex:
    """Unit descriptors of keyframes, numbered as they come, searched exhaustively.

    Args:
        dimensions: length D of a descriptor.

    Raises:
        DependencyError: FAISS cannot be loaded.
    """

    def __init__(self, dimensions: int) -> None:
        self.dimensions = dimensions
        self._index = faiss().IndexFlatL2(dimensions)

    def __len__(self) -> int:
        return int(self._index.ntotal)

    def add(self, descriptor: NDArray[np.float32]) -> int:
        """Add a keyframe's descriptor [D] of unit length; returns its number.

        Raises:
            ValueError: it has another length or norm.
        """
        self._index.add(self._row(descriptor))
        return len(self) - 1

    def search(
        self,
        descriptor: NDArray[np.float32],
        count: int,
        among: Collection[int] | NDArray[np.integer] | None = None,
    ) -> list[Neighbour]:
        """The nearest keyframes, nearest first; of equal ones the older.

        Args:
            descriptor: [D] of unit length.
            count: at most so many.
            among: numbers of the keyframes to choose from, None for all.

        Raises:
            ValueError: the descriptor has another length or norm, or a number is unknown.
        """
        query = self._row(descriptor)
        numbers = np.arange(len(self)) if among is None else np.unique(list(among))
        if numbers.size and not 0 <= numbers[0] <= numbers[-1] < len(self):
            raise ValueError(f"keyframes must be within 0..{len(self) - 1}, got {numbers}")
        if not numbers.size or count < 1:
            return []
        library = faiss()
        chosen = library.SearchParameters(sel=library.IDSelectorBatch(numbers.astype(np.int64)))
        # All of them, for which of equal ones make the cut is otherwise up to FAISS.
        squares, found = self._index.search(query, len(numbers), params=chosen)
        order = np.lexsort((found[0], squares[0]))[:count]
        return [_neighbour(int(found[0, i]), float(squares[0, i])) for i in order]

    def descriptor(self, keyframe: int) -> NDArray[np.float32]:
        """The descriptor [D] of a keyframe."""
        return np.array(self._index.reconstruct(keyframe))

    def state(self) -> dict[str, NDArray]:
        """Arrays that `from_state` restores to identical answers."""
        return {"descriptors": np.array(self._index.reconstruct_n(0, len(self)))}

    @classmethod
    def from_state(cls, state: dict[str, NDArray], dimensions: int) -> DescriptorIndex:
        """The index that `state` came from.

        Raises:
            ValueError: its descriptors have another length.
        """
        index = cls(dimensions)
        for descriptor in state["descriptors"]:
            index.add(descriptor)
        return index

    def _row(self, descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        if descriptor.shape != (self.dimensions,):
            raise ValueError(
                f"a descriptor must have shape [{self.dimensions}], got {list(descriptor.shape)}"
            )
        row = np.ascontiguousarray(descriptor, dtype=np.float32)[None]
        # Written so that NaN fails, too.
        if not abs(float(np.linalg.norm(row)) - 1.0) < _UNIT_TOLERANCE:
            raise ValueError(f"a descriptor must have length 1, got {np.linalg.norm(row):.3f}")
        return row


@functools.cache
def faiss() -> ModuleType:
    """The faiss module.

    Raises:
        DependencyError: it cannot be loaded.
    """
    try:
        import faiss as module
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"FAISS cannot be loaded ({error}); fix it with: pip install faiss-cpu"
        ) from error
    return module


def _neighbour(keyframe: int, square: float) -> Neighbour:
    # Rounding can leave a tiny negative square.
    square = max(0.0, square)
    return Neighbour(keyframe, math.sqrt(square), 1.0 - square / 2.0)
