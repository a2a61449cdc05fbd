"""The local server of `semsplat view`: the page, and the map that it shows."""

from __future__ import annotations

import json
import re
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from ipaddress import ip_address

from toolkit.io.addresses import is_local, url_of
from toolkit.tools.viewer.connections import BoundedServer, RequestHandler
from toolkit.tools.viewer.html import served_page
from toolkit.tools.viewer.streaming import ServedMap

# Time in which the server notices that it is stopped.
_STOP_S = 0.1
_CHUNK = re.compile(r"/chunks/(\d{1,15})/(\d{1,9})")
_HTML, _JSON, _BYTES, _TEXT = (
    "text/html; charset=utf-8",
    "application/json",
    "application/octet-stream",
    "text/plain; charset=utf-8",
)
# No other page may embed, read or control what is sent. The page has a policy of its own for its
# content.
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
_PAGE_POLICY, _DATA_POLICY = "frame-ancestors 'none'", "default-src 'none'; frame-ancestors 'none'"


@dataclass(frozen=True)
class ServedState:
    """What is served at a time.

    Attributes:
        version: of the map, which grows; 0 while there is none.
        scene: the map as the page loads it.
        chunk: returns a part of a streamed map by its number.
        finished: whether there will be no other state.
        message: a line for the page.
    """

    version: int = 0
    scene: bytes | None = None
    chunk: Callable[[int], bytes | None] = lambda _number: None
    finished: bool = False
    message: str = ""

    @property
    def described(self) -> bytes:
        values = {"version": self.version, "finished": self.finished, "message": self.message}
        return json.dumps(values).encode()


class MapServer:
    """Serves a map, which may be replaced, to browsers from threads of its own.

    The page at `/` contains the program. It asks for `state`, and loads `scene` when its version
    is new, and `chunks/VERSION/NUMBER` of streamed maps.

    Args:
        bound: a listening socket; the server closes it.
        host: the address as the user has named it.

    Attributes:
        url: the address of the page.
        page: the page.
        state: what is served.
        is_own: tells whether a name in a URL is that of this server.
    """

    def __init__(self, bound: socket.socket, host: str = "localhost") -> None:
        self.url = url_of(bound).rstrip("/")
        self.page = served_page()
        self.state = ServedState()
        self.is_own = own_names(bound, host)

        class Handler(_Handler):
            served = self

        self._server = BoundedServer(bound, Handler)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_STOP_S,), daemon=True
        )
        self._thread.start()

    def show(self, shown: ServedMap, message: str = "", finished: bool = False) -> None:
        """Serve a map in place of the one before.

        Args:
            shown: the map.
            message: a line for the page.
            finished: whether it is the last one.
        """
        # Pages may know versions of another process that was listening here before.
        version = max(self.state.version + 1, int(1000.0 * time.time()))
        packed = shown.packed()
        packed.header["version"] = version
        self.state = ServedState(version, bytes(packed), shown.chunk, finished, message)

    def report(self, message: str) -> None:
        """Show a line in the page beside the map."""
        self.state = replace(self.state, message=message)

    def stop(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def own_names(bound: socket.socket, host: str) -> Callable[[str], bool]:
    """Return a function that tells whether a name in a URL can only be that of this server.

    Pages of other hosts must not read a map through a name that they resolve to this machine (DNS
    rebinding). Numeric addresses are not resolved.
    """
    if is_local(bound.getsockname()[0]):
        return is_local
    own = socket.gethostname().lower()
    first = own.partition(".")[0]
    names = {"localhost", host.lower(), own, first, f"{first}.local"} - {""}

    def is_own(name: str) -> bool:
        try:
            ip_address(name)
        except ValueError:
            return name in names
        return True

    return is_own


class _Handler(RequestHandler):
    served: MapServer

    def do_GET(self) -> None:
        path, state = self.path.partition("?")[0], self.served.state
        chunk = _CHUNK.fullmatch(path)
        refusal = self._refusal(path)
        if refusal:
            self._send(403, _TEXT, f"{refusal}\n".encode())
        elif path == "/":
            self._send(200, _HTML, self.served.page)
        elif path == "/state":
            self._send(200, _JSON, state.described)
        elif path == "/scene" and state.scene is not None:
            self._send(200, _BYTES, state.scene)
        elif (
            chunk
            and int(chunk[1]) == state.version
            and (content := state.chunk(int(chunk[2]))) is not None
        ):
            self._send(200, _BYTES, content)
        else:
            self._send(404, _TEXT, b"not found\n")

    def _refusal(self, path: str) -> str:
        """Why a request is refused, which may come from another page; empty if it is not."""
        hosts = self.headers.get_all("Host", [])
        host = hosts[0].strip().lower() if len(hosts) == 1 else ""
        name = re.sub(r":\d*$", "", host)
        if not self.served.is_own(name.strip("[]")):
            return (
                "this address is not that of the map; open the one that semsplat view prints, or "
                "name this one with --host"
            )
        site = self.headers.get("Sec-Fetch-Site", "none")
        # A link to the page itself is harmless: it has no data, and no other page can read it.
        is_link = path == "/" and (
            self.headers.get("Sec-Fetch-Mode"),
            self.headers.get("Sec-Fetch-Dest"),
        ) == ("navigate", "document")
        origins = self.headers.get_all("Origin", [])
        if any(origin.strip().lower() != f"http://{host}" for origin in origins) or (
            site not in ("same-origin", "none") and not is_link
        ):
            return "the map is not for other pages; open this address itself"
        return ""

    def _send(self, status: int, kind: str, content: bytes) -> None:
        policy = _PAGE_POLICY if kind == _HTML else _DATA_POLICY
        self.answer(status, kind, content, {**_HEADERS, "Content-Security-Policy": policy})
