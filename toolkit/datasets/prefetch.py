"""Prefetch frames in a background thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol

from toolkit.frame import Frame

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
    """Yield the frames with these indices in order, of which up to `ahead` are read in advance.

    Exceptions of reading and preparing a frame are raised in place of the frame. The thread ends
    when the iterator is exhausted or closed.

    Args:
        dataset: source of the frames; it must not be used by other threads meanwhile.
        indices: indices of the frames.
        ahead: maximum number of prefetched frames in memory, >= 1.
        prepare: called by the thread with each frame before it is yielded.
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

    def read() -> None:
        try:
            for index in indices:
                frame = dataset[index]
                if prepare is not None:
                    prepare(frame)
                if not put(frame):
                    return
        except Exception as error:  # noqa: BLE001 - raised again by the consumer
            put(error)
        finally:
            put(_END)

    reader = threading.Thread(target=read, name="prefetch", daemon=True)
    reader.start()
    try:
        while (item := waiting.get()) is not _END:
            if isinstance(item, Exception):
                raise item
            yield item
    finally:
        closed.set()
        reader.join()
