"""A bounded number of computations at a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, TypeVar

Answer = TypeVar("Answer")
Kind = Literal["renders", "queries"]
KINDS: tuple[Kind, ...] = ("renders", "queries")


class OverloadedError(Exception):
    """Too many computations wait."""


class Computations:
    """Computes the answers of one kind one after another, each kind in its own thread.

    The first query for all objects of a map can take seconds; renders do not wait for it.

    Args:
        max_waiting: maximum number of computations, including the current ones.
    """

    def __init__(self, max_waiting: int) -> None:
        self._max_waiting = max_waiting
        self._waiting = 0
        self._threads = {
            kind: ThreadPoolExecutor(max_workers=1, thread_name_prefix=kind) for kind in KINDS
        }

    async def run(self, kind: Kind, compute: Callable[[], Answer]) -> Answer:
        """Compute an answer.

        Raises:
            OverloadedError: too many computations wait.
        """
        if self._waiting >= self._max_waiting:
            raise OverloadedError
        self._waiting += 1
        future = asyncio.get_running_loop().run_in_executor(self._threads[kind], compute)
        future.add_done_callback(self._done)
        # A client that disconnects cancels its handler, but not a computation that has begun.
        return await asyncio.shield(future)

    def _done(self, future: asyncio.Future[Answer]) -> None:
        self._waiting -= 1
        if not future.cancelled():
            future.exception()  # retrieved, also where nobody waits for it any more

    def close(self) -> None:
        """Drop waiting computations and wait for the current ones."""
        for thread in self._threads.values():
            thread.shutdown(wait=True, cancel_futures=True)
