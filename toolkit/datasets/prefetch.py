"""Prefetch frames, or groups of them, in a background thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

from toolkit.base.frame import Frame

Item = TypeVar("Item")

_END = object()
# Interval at which a blocked reader checks whether the iterator was closed.
_POLL_S = 0.05


class Frames(Protocol):
    """Frames by their index."""

    def __getitem__(self, index: int) -> Frame: ...


def prefetched(
    dataset: Frames,
    indices: Iterable[int],
    ahead: int = 4,
    prepare: Callable[[Frame], None] | None = None,
) -> Iterator[Frame]:
    """Yield the frames with these indices in order, see `read_ahead`.

    Args:
        dataset: source of the frames; it must not be used by other threads meanwhile.
        indices: indices of the frames.
        ahead: maximum number of prefetched frames in memory, >= 1.
        prepare: called by the thread with each frame before it is yielded.
    """

    def read(index: int) -> Frame:
        frame = dataset[index]
        if prepare is not None:
            prepare(frame)
        return frame

    return read_ahead(read, indices, ahead)


def read_ahead(read: Callable[[int], Item], keys: Iterable[int], ahead: int = 4) -> Iterator[Item]:
    """Yield what is read for each key in order; a thread reads up to `ahead` items in advance.

    Exceptions of reading an item are raised in place of the item. The thread ends when the iterator
    is exhausted or closed.

    Args:
        read: called by the thread.
        keys: numbers of the items.
        ahead: maximum number of items that wait in memory, >= 1.
    """
    waiting: queue.Queue = queue.Queue(maxsize=ahead)
    closed = threading.Event()

    def put(item: object) -> bool:
        while not closed.is_set():
            try:
                waiting.put(item, timeout=_POLL_S)
                return True
            except queue.Full:
                continue
        return False

    def run() -> None:
        try:
            for key in keys:
                if not put(read(key)):
                    return
        except Exception as error:  # noqa: BLE001 - raised again by the consumer
            put(error)
        finally:
            put(_END)

    reader = threading.Thread(target=run, name="prefetch", daemon=True)
    reader.start()
    try:
        while (item := waiting.get()) is not _END:
            if isinstance(item, Exception):
                raise item
            yield item
    finally:
        closed.set()
        reader.join()
