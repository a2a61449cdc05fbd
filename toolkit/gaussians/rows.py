"""Rows of tensors: appended and removed without copying all the others."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

# Memory of a tensor that grows, relative to its rows. Pages that are never written take no memory.
_GROWTH = 1.5
_ATTRIBUTE = "_room"


@dataclass
class _Room:
    """The memory that tensors with the same first rows share.

    Attributes:
        rows: how many it has room for. used: rows of the longest of these tensors.
    """

    rows: int
    used: int


def append_rows(tensor: Tensor, rows: Tensor) -> Tensor:
    """A tensor [N, ...] followed by rows [M, ...].

    The result shares its memory with the tensor if that was created here, with room behind it that
    no other result uses.
    """
    present, count = len(tensor), len(tensor) + len(rows)
    room = getattr(tensor, _ATTRIBUTE, None)
    if room is None or room.used != present or room.rows < count:
        grown = tensor.new_empty(math.ceil(_GROWTH * count), *tensor.shape[1:])
        grown[:present] = tensor
        tensor, room = grown, _Room(len(grown), 0)
    joined = _first_rows(tensor, count, room)
    joined[present:] = rows
    return joined


@dataclass(frozen=True)
class Removal:
    """Removal of some rows, in whose places the last of the others move.

    Attributes:
        count: number of rows that are left.
        places: [K] int64 removed rows among the first `count`.
        moved: [K] int64 rows behind them that are left.
    """

    count: int
    places: Tensor
    moved: Tensor

    @classmethod
    def of(cls, mask: Tensor) -> Removal:
        """Removal of the rows in a mask [N]."""
        count = len(mask) - int(mask.sum())
        places = mask[:count].nonzero().squeeze(1)
        moved = (~mask[count:]).nonzero().squeeze(1) + count
        return cls(count, places, moved)

    def apply(self, tensor: Tensor) -> Tensor:
        """Remove the rows of a tensor [N, ...] in place, and return the others.

        The order changes, but only as many rows are copied as are removed.
        """
        tensor.index_copy_(0, self.places, tensor.index_select(0, self.moved))
        room = getattr(tensor, _ATTRIBUTE, None)
        if room is None or room.used != len(tensor):
            return tensor[: self.count]
        return _first_rows(tensor, self.count, room)


def _first_rows(memory: Tensor, count: int, room: _Room) -> Tensor:
    """The first rows of the memory of a tensor, which may have fewer."""
    rows = memory.as_strided((count, *memory.shape[1:]), memory.stride())
    room.used = count
    setattr(rows, _ATTRIBUTE, room)
    return rows
