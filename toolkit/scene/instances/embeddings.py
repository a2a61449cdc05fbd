"""Embeddings of the masks of an object, of which a few from all parts of its path are kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.embedding_fusion import FusedEmbedding, fuse_views

# Maximum number of embeddings of an object, in half precision: 16 kB for 512 values.
MAX_VIEWS = 16


class ViewEmbeddings:
    """The best views of an object, spread evenly over all of its views.

    Consecutive views form a group, of which the view with the greatest weight is kept. Groups are
    joined in pairs when there are too many, so that memory and time do not grow with the views.

    Attributes:
        frames: frame index of each kept view, ascending.
    """

    def __init__(self) -> None:
        self.frames: list[int] = []
        self._weights: list[float] = []
        self._vectors: list[NDArray[np.float16]] = []
        self._group = 1  # number of views of a complete group
        self._last = 0  # number of views of the last group
        self._fused: FusedEmbedding | None = None

    def __len__(self) -> int:
        """Number of kept views."""
        return len(self.frames)

    def add(self, frame: int, weight: float, embedding: NDArray[np.floating]) -> None:
        """Add the newest view; embeddings of zeros are unknown and not added.

        Args:
            frame: frame index.
            weight: weight in the fusion, 0 or more.
            embedding: [D].
        """
        if not embedding.any():
            return
        if self._last in (0, self._group):
            if len(self) == MAX_VIEWS:
                self._join_pairs()
            self._last = 0
            self._append(frame, weight, embedding.astype(np.float16))
        elif weight > self._weights[-1]:
            self._pop()
            self._append(frame, weight, embedding.astype(np.float16))
        self._last += 1

    def absorb(self, other: ViewEmbeddings) -> None:
        """Add all views of another object."""
        rows = sorted([*self._rows(), *other._rows()], key=lambda row: row[:2])
        self._group = self._last = max(self._group, other._group)
        self.frames = [row[0] for row in rows]
        self._weights = [row[1] for row in rows]
        self._vectors = [row[2] for row in rows]
        self._fused = None
        while len(self) > MAX_VIEWS:
            self._join_pairs()

    def fused(self) -> FusedEmbedding | None:
        """The embedding of the object, without the views that disagree; None if unknown."""
        if self._fused is None and self.frames:
            vectors = np.stack(self._vectors).astype(np.float32)
            self._fused = fuse_views(vectors, np.array(self._weights))
        return self._fused

    def _rows(self) -> list[tuple[int, float, NDArray[np.float16]]]:
        return list(zip(self.frames, self._weights, self._vectors, strict=True))

    def _append(self, frame: int, weight: float, vector: NDArray[np.float16]) -> None:
        self.frames.append(frame)
        self._weights.append(weight)
        self._vectors.append(vector)
        self._fused = None

    def _pop(self) -> None:
        for column in (self.frames, self._weights, self._vectors):
            column.pop()

    def _join_pairs(self) -> None:
        """Keep the better view of every two neighbours."""
        ends = range(0, len(self), 2)
        kept = [max(range(k, min(k + 2, len(self))), key=self._weights.__getitem__) for k in ends]
        self.frames = [self.frames[k] for k in kept]
        self._weights = [self._weights[k] for k in kept]
        self._vectors = [self._vectors[k] for k in kept]
        self._group *= 2
        self._last = self._group

    def values(self) -> dict[str, Any]:
        """JSON values, without the vectors."""
        return {
            "frames": self.frames,
            "weights": self._weights,
            "group": self._group,
            "last": self._last,
        }

    def vectors(self) -> NDArray[np.float16]:
        """The kept embeddings [V, D]; [0, 0] without any."""
        return np.stack(self._vectors) if self._vectors else np.zeros((0, 0), np.float16)

    @classmethod
    def from_values(cls, values: Mapping[str, Any], vectors: NDArray[np.float16]) -> ViewEmbeddings:
        """Restore the views from their `values` and `vectors`."""
        restored = cls()
        restored.frames = [int(frame) for frame in values["frames"]]
        restored._weights = [float(weight) for weight in values["weights"]]
        restored._vectors = list(vectors)
        restored._group, restored._last = int(values["group"]), int(values["last"])
        return restored
