"""A pretended CUDA device: tensors that compute on the CPU and behave as if they did not.

They say that they are on "cuda:0", refuse `.numpy()` and a pointer to their data, and refuse to
meet tensors of the CPU, as a GPU's do. So a stage that forgets where its inputs are fails here
too, where no GPU is. Autograd and kernels want a true device: tests stand in for them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

_CUDA = torch.device("cuda", 0)
# Between devices by their nature; indices may be on the CPU.
_MOVES = {"aten::_to_copy", "aten::copy_", "aten::index", "aten::index_put_"}


class _OnGpu(torch.Tensor):
    """A tensor on the pretended device; `held` computes."""

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> _OnGpu:
        return torch.Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=_CUDA,
            requires_grad=held.requires_grad,
        )

    def __init__(self, held: torch.Tensor) -> None:
        self.held = held

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _dispatched(function, args, kwargs or {})


class _Factories(TorchDispatchMode):
    """Makes new tensors on the pretended device, where they are asked for there."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _dispatched(function, args, kwargs or {})


def _dispatched(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
    there = [x for x in tensors if isinstance(x, _OnGpu)]
    asked = kwargs.get("device")
    asked = None if asked is None else torch.device(asked).type
    name = function._schema.name
    strangers = [x for x in tensors if not isinstance(x, _OnGpu) and x.dim() > 0]
    if there and strangers and name not in _MOVES:
        raise RuntimeError(f"{name}: tensors of the CPU meet tensors of a GPU")
    if asked == "cuda":
        kwargs = kwargs | {"device": "cpu"}
    onto = asked == "cuda" or (asked is None and bool(there))
    if name in _MOVES - {"aten::_to_copy"}:
        onto = isinstance(args[0], _OnGpu)

    def inner(x: Any) -> Any:
        return x.held if isinstance(x, _OnGpu) else x

    out = function(*tree_map(inner, args), **tree_map(inner, kwargs))
    if function._schema.is_mutable:  # it changed what was given, which is its answer
        return args[0]
    return tree_map(lambda x: _OnGpu(x) if onto and isinstance(x, torch.Tensor) else x, out)


@contextmanager
def pretended_gpu() -> Iterator[None]:
    """While it lasts, tensors can be on "cuda:0"."""
    torch._C._ensureCUDADeviceGuardSet()  # as torch does for its own fake tensors
    with mock.patch.object(torch.cuda, "_lazy_init"), _Factories():
        yield
