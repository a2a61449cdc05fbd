"""Rows of tensors in memory with spare room, so that appending does not copy all rows before."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

# Memory of a tensor that grows, relative to its rows. On a CPU, pages take memory when written.
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


def select_rows(tensor: Tensor, indices: Tensor) -> Tensor:
    """The rows `indices` [M] of a tensor [N, ...], in memory with room for more."""
    count = len(indices)
    memory = tensor.new_empty(math.ceil(_GROWTH * count), *tensor.shape[1:])
    selected = _first_rows(memory, count, _Room(len(memory), 0))
    return torch.index_select(tensor, 0, indices, out=selected)


def _first_rows(memory: Tensor, count: int, room: _Room) -> Tensor:
    """The first rows of the memory of a tensor, which may have fewer."""
    rows = memory.as_strided((count, *memory.shape[1:]), memory.stride())
    room.used = count
    setattr(rows, _ATTRIBUTE, room)
    return rows
