"""Clients that send nothing, or half a request, do not lock out others."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

uvicorn = pytest.importorskip("uvicorn")

from toolkit.tools.serving import connections  # noqa: E402

MOST = 4
REQUEST = b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"
POST = b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 100\r\n\r\nhalf"


async def application(_scope: Any, receive: Any, send: Any) -> None:
    """Answers once it has the whole body."""
    while (message := await receive()).get("more_body"):
        pass
    if message["type"] == "http.disconnect":
        return
    length = [(b"content-length", b"2")]
    await send({"type": "http.response.start", "status": 200, "headers": length})
    await send({"type": "http.response.body", "body": b"ok"})


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A service with few connections and little patience."""
    monkeypatch.setattr(connections, "REQUEST_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as bound:
        config = uvicorn.Config(
            application,
            http=connections.bounded_protocol(MOST),
            lifespan="off",
            log_level="warning",
            timeout_keep_alive=60,
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=lambda: server.run(sockets=[bound]), daemon=True)
        thread.start()
        yield bound.getsockname()[1]
        server.should_exit = server.force_exit = True
        thread.join(10.0)


def connected(port: int, content: bytes = b"") -> socket.socket:
    client = socket.create_connection(("127.0.0.1", port), timeout=5.0)
    client.sendall(content)
    return client


def answer(client: socket.socket) -> bytes:
    """What a connection receives until it is closed, or the answer is complete."""
    received = b""
    try:
        while not received.endswith(b"ok") and (piece := client.recv(4096)):
            received += piece
    except ConnectionResetError:
        pass
    return received


@pytest.mark.parametrize("content", [b"", REQUEST[:-2], POST])
def test_requests_that_are_not_completed_end(port: int, content: bytes):
    client, begin_s = connected(port, content), time.monotonic()
    assert answer(client) == b""
    assert time.monotonic() - begin_s < 4.0


def test_a_connection_may_wait_between_requests_but_not_within_them(port: int):
    client = connected(port, REQUEST)
    assert answer(client).endswith(b"ok")
    time.sleep(0.5)
    client.sendall(REQUEST)
    assert answer(client).endswith(b"ok")
    client.sendall(REQUEST[:-2])
    assert answer(client) == b""


@pytest.mark.parametrize("content", [b"", REQUEST[:-2], POST, REQUEST])
def test_idle_connections_lock_nobody_out(port: int, content: bytes, caplog):
    idle = [connected(port, content) for _ in range(3 * MOST)]
    if content == REQUEST:
        assert answer(idle[-1]).endswith(b"ok")
    assert answer(connected(port, REQUEST)).startswith(b"HTTP/1.1 200")
    assert not caplog.records
    for client in idle:
        client.close()
