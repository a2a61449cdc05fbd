"""Masks of single views, and the interface of their sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from toolkit.base.keyframe import Keyframe


@dataclass(frozen=True, eq=False)
class InstanceMasks:
    """The masks of one image; every pixel belongs to one mask at most.

    Attributes:
        ids: [H, W] int32, the mask of each pixel as a row of the other attributes plus 1; 0 is
            none.
        classes: [K] names of the masks' classes, None where unknown.
        scores: [K] float32 confidences in [0, 1].
        embeddings: [K, D] float32 of unit length, all 0 where unknown; D is 0 without embeddings.
        model: name of the model of the embeddings, empty if unknown.

    Raises:
        ValueError: shapes do not match.
    """

    ids: NDArray[np.int32]
    classes: Sequence[str | None]
    scores: NDArray[np.float32]
    embeddings: NDArray[np.float32]
    model: str = ""

    def __post_init__(self) -> None:
        count = len(self.classes)
        if self.scores.shape != (count,) or self.embeddings.shape[:1] != (count,):
            raise ValueError(
                f"{count} classes need scores [{count}] and embeddings [{count}, D], got "
                f"{list(self.scores.shape)} and {list(self.embeddings.shape)}"
            )
        if self.ids.size and not 0 <= self.ids.min() <= self.ids.max() <= count:
            raise ValueError(f"ids must lie in 0 to {count}, got up to {self.ids.max()}")

    def __len__(self) -> int:
        """Number of masks."""
        return len(self.classes)

    def select(self, rows: NDArray[np.intp]) -> InstanceMasks:
        """Return the masks of some rows [M], ascending; the pixels of others have no mask."""
        table = np.zeros(len(self) + 1, np.int32)
        table[rows + 1] = np.arange(1, len(rows) + 1)
        classes = [self.classes[k] for k in rows]
        scores, embeddings = self.scores[rows], self.embeddings[rows]
        return InstanceMasks(table[self.ids], classes, scores, embeddings, self.model)

    @classmethod
    def of_ids(cls, ids: NDArray[np.integer]) -> InstanceMasks:
        """Masks without classes and embeddings from any ids [H, W]; 0 is none."""
        found, rows = np.unique(ids, return_inverse=True)
        rows = rows.reshape(ids.shape) + (0 if len(found) and found[0] == 0 else 1)
        count = int(rows.max(initial=0))
        return cls(
            rows.astype(np.int32),
            [None] * count,
            np.ones(count, np.float32),
            np.zeros((count, 0), np.float32),
        )


class MaskSource(Protocol):
    """Yields the masks of keyframes; frames are independent of each other."""

    def masks(self, keyframe: Keyframe) -> InstanceMasks | None:
        """Return the masks of a keyframe, None if there are none for it.

        Raises:
            DatasetError: the masks of the frame are invalid.
        """
        ...


@runtime_checkable
class NamedClasses(Protocol):
    """A source of masks that states the classes of its masks beforehand."""

    def class_names(self) -> set[str]:
        """Return the names of all classes.

        Raises:
            DatasetError: a file cannot be read.
        """
        ...
