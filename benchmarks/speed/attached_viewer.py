"""A viewer attached to a run in progress: `semsplat view --live` with one client.

The client asks for what the page in a browser would, and draws nothing.
"""

from __future__ import annotations

import http.client
import json
import signal
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.shared.programs import start_semsplat_server

# The page asks every second.
_POLL_S, _ASK_S = 0.05, 1.0
# Printed by the viewer when it shows a state of a run in progress.
_SHOWN, _OF_A_FRAME = "Show ", ", frame "


@dataclass
class ViewerLoad:
    """What the viewer has shown.

    Attributes:
        updates: number of states of the run in progress.
        received_mb: data sent to the client.
    """

    updates: int = 0
    received_mb: float = 0.0


@contextmanager
def attached_viewer(run: Path) -> Iterator[ViewerLoad]:
    """Attach a viewer to a run that starts in the block; what it has shown is complete after it.

    Args:
        run: the run folder, which need not exist yet.
    """
    load, ended = ViewerLoad(), threading.Event()
    thread = threading.Thread(target=_follow, args=(run, load, ended), name="viewer", daemon=True)
    thread.start()
    try:
        yield load
    finally:
        ended.set()
        thread.join()


def _follow(run: Path, load: ViewerLoad, ended: threading.Event) -> None:
    while not (run / "config.yaml").is_file():
        if ended.wait(_POLL_S):
            return
    server, url = start_semsplat_server("view", str(run), "--live", "--port", "0")
    try:
        _receive(url.removeprefix("http://"), load, ended)
    finally:
        server.send_signal(signal.SIGINT)
        messages = server.communicate()[1].splitlines()
    load.updates = sum(m.startswith(_SHOWN) and _OF_A_FRAME in m for m in messages)


def _receive(address: str, load: ViewerLoad, ended: threading.Event) -> None:
    version = 0
    while not ended.wait(_ASK_S):
        state = json.loads(_content(address, "/state"))
        if state["version"] != version:
            version = state["version"]
            load.received_mb += len(_content(address, "/scene")) / 1e6


def _content(address: str, path: str) -> bytes:
    connection = http.client.HTTPConnection(address, timeout=60.0)
    with closing(connection):
        connection.request("GET", path)
        return connection.getresponse().read()
