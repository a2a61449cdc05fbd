"""Which requests are admitted: bounded rates per client, and bounded computations at a time."""

from __future__ import annotations

import asyncio
import math
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, TypeVar

Answer = TypeVar("Answer")
Kind = Literal["renders", "queries"]
KINDS: tuple[Kind, ...] = ("renders", "queries")

# Clients that are remembered; the least recent ones are forgotten, so that memory is bounded.
_MAX_CLIENTS = 4096


@dataclass
class _Bucket:
    tokens: float
    at_s: float


class RateLimit:
    """A token bucket for each client.

    Args:
        per_s: requests per second on average.
        burst: requests at once after a pause.
        clock: returns the time in seconds.
    """

    def __init__(
        self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._per_s, self._burst, self._clock = per_s, burst, clock
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def wait_s(self, client: str) -> int:
        """Count a request of a client.

        Returns:
            0 if it is admitted, else the time in whole seconds after which the next one will be.
        """
        now_s = self._clock()
        bucket = self._buckets.pop(client, None) or _Bucket(float(self._burst), now_s)
        self._buckets[client] = bucket  # the most recent one is last
        if len(self._buckets) > _MAX_CLIENTS:
            self._buckets.popitem(last=False)
        refilled = bucket.tokens + (now_s - bucket.at_s) * self._per_s
        bucket.tokens, bucket.at_s = min(float(self._burst), refilled), now_s
        if bucket.tokens < 1.0:
            return max(1, math.ceil((1.0 - bucket.tokens) / self._per_s))
        bucket.tokens -= 1.0
        return 0


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
