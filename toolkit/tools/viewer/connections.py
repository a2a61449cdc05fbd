"""An HTTP server with limits: connections, threads, and the time and size of a request."""

from __future__ import annotations

import io
import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

_log = logging.getLogger(__name__)

# Each connection has a thread.
MAX_CONNECTIONS = 64
# A connection ends if it has not sent a whole request after this time, or so many bytes. Browsers
# send the cookies of all services of a computer to each of them.
REQUEST_S, _REQUEST_BYTES = 5.0, 65_536
# A client must take each piece of an answer in this time.
_PIECE_S, _PIECE_BYTES = 30.0, 1 << 20
# Time in which the thread of a connection that was shut down ends.
_END_S = 1.0
_END_OF_HEADERS = b"\r\n\r\n"
_BUSY = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class BoundedServer(ThreadingHTTPServer):
    """Answers each connection in a thread of its own.

    If all threads are taken, the connection that has waited longest for its client is closed, so
    that idle clients do not lock out others. If none waits, the new one is refused.

    Args:
        bound: a listening socket; the server closes it.
        handler: a class that answers the requests.
    """

    daemon_threads = True

    def __init__(self, bound: socket.socket, handler: type[RequestHandler]) -> None:
        # The base class would look up the name of the host, which can be a request to a DNS server.
        super().__init__(("", 0), handler, bind_and_activate=False)
        self.socket.close()
        self.socket = bound
        self.server_address = bound.getsockname()
        self.closed = False
        self._free = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self._waiting: dict[socket.socket, None] = {}  # the oldest first
        self._lock = threading.Lock()

    @contextmanager
    def waiting(self, connection: socket.socket) -> Iterator[None]:
        """Mark a connection as one that waits for its client."""
        with self._lock:
            self._waiting[connection] = None
        try:
            yield
        finally:
            with self._lock:
                self._waiting.pop(connection, None)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start the thread of a new connection."""
        free = self._free.acquire(blocking=False)
        if not free and self._end_oldest():
            free = self._free.acquire(timeout=_END_S)
        if not free:
            self._refuse(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # the system has no more threads
            self._free.release()
            self._refuse(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer the requests of a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log an error of the server; connections that end early are none."""
        if not isinstance(sys.exc_info()[1], OSError):
            _log.exception("A request of %s was not answered.", client_address[0])

    def server_close(self) -> None:
        """Stop listening and answering; answers that are being sent are completed."""
        super().server_close()
        self.closed = True
        while self._end_oldest():
            pass

    def _end_oldest(self) -> bool:
        """Shut down the connection that has waited longest; returns whether there is one."""
        with self._lock:
            oldest = next(iter(self._waiting), None)
            if oldest is None:
                return False
            del self._waiting[oldest]
            with suppress(OSError):  # it may have just ended
                oldest.shutdown(socket.SHUT_RDWR)
            return True

    def _refuse(self, request: socket.socket) -> None:
        with suppress(OSError):
            request.setblocking(False)
            request.send(_BUSY)
        self.shutdown_request(request)


class RequestHandler(BaseHTTPRequestHandler):
    """Reads GET requests; a subclass implements `do_GET` and calls `answer`."""

    server: BoundedServer
    protocol_version = "HTTP/1.1"  # connections are kept, as one page loads many parts of a map
    server_version, sys_version = "semsplat", ""

    def setup(self) -> None:
        """Prepare a new connection."""
        super().setup()
        # Requests are read from the socket, because this stream has no limit of time.
        self.rfile.close()
        self._received = bytearray()

    def handle_one_request(self) -> None:
        """Read and answer a request."""
        self.close_connection = True
        with self.server.waiting(self.connection):
            head = self._read_head()
        if head is None or self.server.closed:
            return
        self.rfile = io.BytesIO(head)
        self.raw_requestline = self.rfile.readline()
        if not self.parse_request():
            return
        if self.command != "GET":
            self.send_error(501)
        elif "Content-Length" in self.headers or "Transfer-Encoding" in self.headers:
            self.send_error(400)  # what follows would count as the next request
        else:
            self.do_GET()

    def do_GET(self) -> None:
        """Answer the request."""
        raise NotImplementedError

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with an error, and close the connection."""
        self.answer(code, "text/plain", b"", {"Connection": "close"})

    def answer(
        self, status: int, kind: str, content: bytes, headers: dict[str, str] | None = None
    ) -> None:
        """Send an answer.

        Args:
            kind: MIME type of the content.
            headers: other headers of the answer.
        """
        fields = {"Content-Type": kind, "Content-Length": str(len(content)), **(headers or {})}
        try:
            self.connection.settimeout(_PIECE_S)
            self.send_response(status)
            for name, value in fields.items():
                self.send_header(name, value)
            self.end_headers()
            for begin in range(0, len(content), _PIECE_BYTES):
                with self.server.waiting(self.connection):
                    self.wfile.write(memoryview(content)[begin : begin + _PIECE_BYTES])
        except OSError:
            self.close_connection = True  # the page was closed meanwhile

    def log_message(self, *words: object) -> None:
        """Log a request."""
        _log.debug(*words)

    def _read_head(self) -> bytes | None:
        """Return the next request up to the end of its headers; None if it does not come."""
        end_s = time.monotonic() + REQUEST_S
        received, searched = self._received, 0
        while (end := received.find(_END_OF_HEADERS, searched)) < 0:
            searched = max(len(received) - len(_END_OF_HEADERS), 0)
            left_s = end_s - time.monotonic()
            if left_s <= 0.0 or len(received) > _REQUEST_BYTES:
                return None
            try:
                self.connection.settimeout(left_s)
                piece = self.connection.recv(4096)
            except OSError:
                return None
            if not piece:
                return None
            received += piece
        end += len(_END_OF_HEADERS)
        head = bytes(received[:end])
        del received[:end]
        return head
