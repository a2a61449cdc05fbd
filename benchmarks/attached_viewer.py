"""A viewer attached to a run in progress: `semsplat view --live` with one client.

The client is a websocket that takes what a browser would take and draws nothing.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from benchmarks.programs import start_semsplat_server

_POLL_S = 0.05
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
        _receive(url.replace("http://", "ws://"), load, ended)
    finally:
        server.send_signal(signal.SIGINT)
        messages = server.communicate()[1].splitlines()
    load.updates = sum(m.startswith(_SHOWN) and _OF_A_FRAME in m for m in messages)


def _receive(url: str, load: ViewerLoad, ended: threading.Event) -> None:
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    with connect(url, subprotocols=[protocol], max_size=None, compression=None) as client:
        while not ended.is_set():
            try:
                load.received_mb += len(client.recv(_POLL_S)) / 1e6
            except TimeoutError:
                continue
            except ConnectionClosed:
                return
