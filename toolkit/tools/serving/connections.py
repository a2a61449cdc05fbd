"""Limits of connections: clients that send nothing, or half a request, lock nobody out."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

# A request must be whole after this time.
REQUEST_S = 5.0
_BUSY = (
    b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nContent-Length: 0\r\n"
    b"Connection: close\r\n\r\n"
)


def bounded_protocol(max_connections: int) -> type[H11Protocol]:
    """Return the protocol of a server with a limit of connections.

    If there are too many, the one that has waited longest for its client is closed. If none waits,
    the new one is refused.
    """

    class Protocol(_BoundedProtocol):
        most = max_connections
        waiting: ClassVar[dict[_BoundedProtocol, None]] = {}  # the oldest first

    return Protocol


class _BoundedProtocol(H11Protocol):
    most: ClassVar[int]
    waiting: ClassVar[dict[_BoundedProtocol, None]]

    def __init__(self, *words: Any, **named: Any) -> None:
        super().__init__(*words, **named)
        self._end: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if len(self.connections) > self.most:
            oldest = next(iter(self.waiting), None)
            if oldest is None:
                transport.write(_BUSY)
                transport.close()
                return
            oldest.close()
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        begun = self.conn.their_state is h11.IDLE and bool(self.conn.trailing_data[0])
        if begun or self.conn.their_state is h11.SEND_BODY:
            self._wait()
        else:
            self._stop_waiting()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if not self.transport.is_closing() and self.conn.their_state is h11.IDLE:
            self.waiting[self] = None  # for the next request, as long as uvicorn waits

    def close(self) -> None:
        """End the connection."""
        self._stop_waiting()
        self.connections.discard(self)
        self.transport.abort()

    def _wait(self) -> None:
        """Give the client the rest of the time for its request."""
        if self._end is None:
            self.waiting[self] = None
            self._end = self.loop.call_later(REQUEST_S, self.close)

    def _stop_waiting(self) -> None:
        self.waiting.pop(self, None)
        if self._end is not None:
            self._end.cancel()
            self._end = None
