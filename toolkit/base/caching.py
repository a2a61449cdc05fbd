"""Caches of values that are used several times."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from numpy.typing import NDArray

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


class ImageStore:
    """Images by key, as long as there is room for them: none is dropped for another one.

    Args:
        max_bytes: of all images.
    """

    def __init__(self, max_bytes: int) -> None:
        self._free_bytes = self._max_bytes = max_bytes
        self._images: dict[Hashable, tuple[NDArray, ...]] = {}

    def get(
        self, key: Hashable, read: Callable[[], tuple[NDArray, ...]], keep: bool
    ) -> tuple[NDArray, ...]:
        """The images of a key, which are read if they are absent, and may then be kept."""
        if (found := self._images.get(key)) is None:
            found = read()
            size = sum(image.nbytes for image in found)
            if keep and size <= self._free_bytes:
                self._images[key], self._free_bytes = found, self._free_bytes - size
        return found

    def clear(self) -> None:
        """Free the memory."""
        self._images, self._free_bytes = {}, self._max_bytes
