"""Read frames ahead of their use, in one background thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

from toolkit.frame import Frame

if TYPE_CHECKING:
    from toolkit.datasets.base import Dataset

_END = object()
# How long a blocked reader waits before it looks whether anyone still wants frames.
_POLL_S = 0.05


def prefetched(
    dataset: Dataset,
    indices: Iterable[int],
    ahead: int = 4,
    prepare: Callable[[Frame], None] | None = None,
) -> Iterator[Frame]:
    """The frames of these indices in order, up to `ahead` of them read in advance.

    Errors of reading and preparing are raised here, in place of the frame. The thread ends when the
    iterator is exhausted or closed.

    Args:
        dataset: where the frames come from; used by the thread alone meanwhile.
        indices: the frames wanted.
        ahead: frames held in memory beside the one in use, >= 1.
        prepare: called with each frame by the thread, before it is handed over.
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
        except Exception as error:  # noqa: BLE001 - the consumer raises it again
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
