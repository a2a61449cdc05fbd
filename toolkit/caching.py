"""Cache of the values that were used last, for what keyframes and frames are often asked for."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class LruCache(Generic[Value]):
    """Values by key; the one that was not used for longest is dropped first.

    Args:
        size: maximum number of values.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._entries: OrderedDict[Hashable, tuple[tuple[object, ...], Value]] = OrderedDict()

    def get(
        self, key: Hashable, compute: Callable[[], Value], sources: tuple[object, ...] = ()
    ) -> Value:
        """The value of a key, computed if it is absent.

        Args:
            sources: objects that the value follows from. It is computed again if they are other
                objects than before, even equal ones.
        """
        entry = self._entries.pop(key, None)
        if entry is None or any(a is not b for a, b in zip(entry[0], sources, strict=True)):
            entry = sources, compute()
        self._entries[key] = entry
        if len(self._entries) > self._size:
            self._entries.popitem(last=False)
        return entry[1]
