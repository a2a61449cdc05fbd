"""Nearest-neighbour search over keyframe descriptors with FAISS."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.features.faiss_library import faiss

_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Neighbour:
    """A keyframe near a query.

    Attributes:
        keyframe: number of the keyframe, in insertion order.
        distance: Euclidean distance in [0, 2]; FAISS returns its squared_distance.
        cosine: cosine similarity of the two descriptors, 1 - distance^2 / 2.
    """

    keyframe: int
    distance: float
    cosine: float


class DescriptorIndex:
    """Exhaustive search index over unit-length descriptors, numbered in insertion order.

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
        """Add a keyframe's descriptor [D] of unit length and return its number.

        Raises:
            ValueError: the descriptor has the wrong shape or norm.
        """
        self._index.add(self._row(descriptor))
        return len(self) - 1

    def search(
        self,
        descriptor: NDArray[np.float32],
        count: int,
        among: Collection[int] | NDArray[np.integer] | None = None,
    ) -> list[Neighbour]:
        """Return the nearest keyframes, nearest first; ties are resolved in favour of the older.

        Args:
            descriptor: [D] of unit length.
            count: maximum number of results.
            among: numbers of the keyframes to search, None for all.

        Raises:
            ValueError: the descriptor has the wrong shape or norm, or a number is unknown.
        """
        query = self._row(descriptor)
        numbers = np.arange(len(self)) if among is None else np.unique(list(among))
        if numbers.size and not 0 <= numbers[0] <= numbers[-1] < len(self):
            raise ValueError(f"keyframe numbers must be in 0..{len(self) - 1}, got {numbers}")
        if not numbers.size or count < 1:
            return []
        library = faiss()
        parameters = library.SearchParameters(sel=library.IDSelectorBatch(numbers.astype(np.int64)))
        # Retrieve all and sort here: FAISS does not define which of several ties it returns.
        squared_distances, found = self._index.search(query, len(numbers), params=parameters)
        order = np.lexsort((found[0], squared_distances[0]))[:count]
        return [_neighbour(int(found[0, i]), float(squared_distances[0, i])) for i in order]

    def descriptor(self, keyframe: int) -> NDArray[np.float32]:
        """Return the descriptor [D] of a keyframe."""
        return np.array(self._index.reconstruct(keyframe))

    def state(self) -> dict[str, NDArray]:
        """Return the arrays from which `from_state` restores an identical index."""
        return {"descriptors": np.array(self._index.reconstruct_n(0, len(self)))}

    @classmethod
    def from_state(cls, state: dict[str, NDArray], dimensions: int) -> DescriptorIndex:
        """Restore an index from its `state`.

        Raises:
            ValueError: the descriptors have the wrong shape.
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
        # The negated comparison also rejects NaN.
        if not abs(float(np.linalg.norm(row)) - 1.0) < _UNIT_TOLERANCE:
            raise ValueError(f"a descriptor must have unit norm, got {np.linalg.norm(row):.3f}")
        return row


def _neighbour(keyframe: int, squared_distance: float) -> Neighbour:
    # Rounding can produce a small negative value.
    squared_distance = max(0.0, squared_distance)
    return Neighbour(keyframe, math.sqrt(squared_distance), 1.0 - squared_distance / 2.0)
