"""The local server of maps that are streamed in levels of detail."""

from __future__ import annotations

import logging
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import AF_INET, AF_INET6

from toolkit.viewer.streaming import StreamedMap

_log = logging.getLogger(__name__)

LOCAL = ("127.0.0.1", "localhost", "::1")
_CHUNK = re.compile(r"/chunks/(\d{1,9})")


class StreamServer:
    """Serves a map to browsers, from threads of its own.

    Args:
        shown: the map.
        host: address to listen on.
        port: free port to listen on; 0 takes any.
    """

    def __init__(self, shown: StreamedMap, host: str, port: int) -> None:
        class Server(ThreadingHTTPServer):
            address_family = AF_INET6 if ":" in host else AF_INET
            daemon_threads = True

        class Handler(_Handler):
            pass

        Handler.shown = shown
        # Pages of other hosts must not read a local map under a name that they resolve to it.
        Handler.names = LOCAL if host in LOCAL else ()
        self._server = Server((host, port), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def get_port(self) -> int:
        """Return the port."""
        return int(self._server.server_address[1])

    def stop(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    # Connections are kept, as one page loads many chunks.
    protocol_version = "HTTP/1.1"
    timeout = 60
    shown: StreamedMap
    names: tuple[str, ...]

    def do_GET(self) -> None:
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0].strip("[]")
        path = self.path.partition("?")[0]
        chunk = _CHUNK.fullmatch(path)
        if self.names and host not in self.names:
            self._answer(403, "text/plain", b"this address is not that of the map\n")
        elif path == "/":
            self._answer(200, "text/html; charset=utf-8", self.shown.page)
        elif chunk and (content := self.shown.chunk(int(chunk[1]))) is not None:
            self._answer(200, "application/octet-stream", content)
        else:
            self._answer(404, "text/plain", b"not found\n")

    def _answer(self, status: int, kind: str, content: bytes) -> None:
        try:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            self.wfile.write(content)
        except ConnectionError:
            self.close_connection = True  # the page was closed meanwhile

    def log_message(self, *words: object) -> None:
        _log.debug(*words)
