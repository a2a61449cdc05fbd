"""Helpers to pass tensors to the kernels: device check and data addresses."""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

from toolkit.base.native.loading import kernels

if TYPE_CHECKING:
    from torch import Tensor


def kernels_for(tensor: Tensor) -> ModuleType | None:
    """Return the kernels if a tensor is in CPU memory and kernels were built, else None.

    Raises:
        DependencyError: see `kernels`.
    """
    return kernels() if tensor.device.type == "cpu" else None


def address(tensor: Tensor | None) -> int:
    """Return the address of a contiguous tensor's data, 0 for None."""
    return 0 if tensor is None else tensor.data_ptr()
