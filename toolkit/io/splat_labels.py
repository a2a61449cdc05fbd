"""Semantic labels of splats, as additional columns of their files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError

# Prefix of the column with the nodes at a level; the level's index follows.
_LEVEL = "label_l"
# Column of the objects of splats.
INSTANCE = "instance"


@dataclass(frozen=True)
class SplatLabels:
    """Semantic labels of splats, stored as additional columns in a PLY.

    Attributes:
        label: [N] int32, class ids, 0 for void.
        levels: [N, L] int32, the node at each level of the class tree, as an index into its
            `nodes`; -1 for void or where the label at that level is uncertain.
        confidence: [N] float32 in [0, 1].
        instances: [N] int32, the object of each splat, 0 for none; None without instances.

    Raises:
        ValueError: shapes do not match.
    """

    label: NDArray[np.int32]
    levels: NDArray[np.int32]
    confidence: NDArray[np.float32]
    instances: NDArray[np.int32] | None = None

    def __post_init__(self) -> None:
        n = len(self.label)
        if self.label.shape != (n,) or self.confidence.shape != (n,):
            raise ValueError(
                f"label and confidence must both have shape [{n}], got "
                f"{list(self.label.shape)} and {list(self.confidence.shape)}"
            )
        if self.levels.ndim != 2 or self.levels.shape[0] != n or self.levels.shape[1] == 0:
            raise ValueError(f"levels must have shape [{n}, L], got {list(self.levels.shape)}")

        if self.instances is not None and self.instances.shape != (n,):
            raise ValueError(f"instances must have shape [{n}], got {list(self.instances.shape)}")

    def __len__(self) -> int:
        return len(self.label)

    def columns(self) -> dict[str, NDArray]:
        """Return the columns by name for `write_splat_ply`."""
        levels = {f"{_LEVEL}{i}": column for i, column in enumerate(self.levels.T)}
        columns = {"label": self.label, **levels, "confidence": self.confidence}
        return columns if self.instances is None else columns | {INSTANCE: self.instances}

    @classmethod
    def from_columns(cls, columns: Mapping[str, NDArray]) -> SplatLabels | None:
        """Build labels from a file's columns; None if the file has no labels of this format.

        Raises:
            FormatError: a level is missing between others.
        """
        # Other tools also write a column "label", with a different type and meaning.
        found = {i: columns[f"{_LEVEL}{i}"] for i in range(99) if f"{_LEVEL}{i}" in columns}
        integers = [columns.get("label"), *found.values()]
        if not found or "confidence" not in columns or not all(map(_is_integer, integers)):
            return None
        if list(found) != list(range(len(found))):
            missing = next(i for i in range(99) if i not in found)
            raise FormatError(f"the splats have no column {_LEVEL}{missing}; write them again")
        return cls(
            label=columns["label"].astype(np.int32),
            levels=np.stack(list(found.values()), axis=1).astype(np.int32),
            confidence=columns["confidence"].astype(np.float32),
            instances=instances_in(columns),
        )

    def select(self, index: NDArray) -> SplatLabels:
        """Select labels by a boolean mask [N] or integer indices [M]."""
        instances = None if self.instances is None else self.instances[index]
        return SplatLabels(self.label[index], self.levels[index], self.confidence[index], instances)


def instances_in(columns: Mapping[str, NDArray]) -> NDArray[np.int32] | None:
    """The objects of splats [N] in a file's columns; None if it has none."""
    column = columns.get(INSTANCE)
    return column.astype(np.int32) if column is not None and _is_integer(column) else None


def _is_integer(column: NDArray | None) -> bool:
    return column is not None and np.issubdtype(column.dtype, np.integer)
