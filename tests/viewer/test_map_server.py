"""The server of `semsplat view`: what it sends, to whom, and its limits."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time

import pytest
from painted_scenes import two_panels

from toolkit.io.addresses import bind
from toolkit.tools.viewer import connections
from toolkit.tools.viewer.connections import MAX_CONNECTIONS
from toolkit.tools.viewer.html import served_page
from toolkit.tools.viewer.packing import pack_splats
from toolkit.tools.viewer.server import MapServer, own_names
from toolkit.tools.viewer.streaming import StreamedMap, WholeMap


@pytest.fixture
def server():
    started = MapServer(bind("127.0.0.1", 0))
    yield started
    started.stop()


def connect(server: MapServer) -> http.client.HTTPConnection:
    return http.client.HTTPConnection(server.url.removeprefix("http://"), timeout=10)


def asked(connection, path: str, method: str = "GET", **headers: str):
    """The status and the content of an answer."""
    fields = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, headers=fields)
    answer = connection.getresponse()
    return answer.status, answer.read()


def idle(server: MapServer, sent: bytes = b"") -> socket.socket:
    """A connection with a part of a request."""
    connection = socket.create_connection(("127.0.0.1", int(server.url.rpartition(":")[2])), 10)
    connection.sendall(sent)
    return connection


def ended(connection: socket.socket) -> bool:
    """Whether the server closes a connection, for which it has ten seconds."""
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


def test_page_state_scene_and_chunks_are_sent_on_one_connection(server):
    shown = StreamedMap.build(two_panels(600), 300, node_size=100, root_size=100)
    connection = connect(server)
    assert asked(connection, "/") == (200, served_page())
    assert json.loads(asked(connection, "/state")[1])["version"] == 0
    assert asked(connection, "/scene")[0] == 404
    server.show(shown, "in progress")
    state = json.loads(asked(connection, "/state")[1])
    version = state["version"]
    assert state == {"version": version, "finished": False, "message": "in progress"}
    packed = shown.packed()
    packed.header["version"] = version
    assert asked(connection, "/scene") == (200, bytes(packed))
    chunk = asked(connection, f"/chunks/{version}/3?")
    assert chunk == (200, bytes(pack_splats(shown.tree.content(3))))
    number = len(shown.tree.nodes)
    for path in (f"{version}/{number}", f"{version}/-1", "1/3", f"{version}/../x", "3"):
        assert asked(connection, f"/chunks/{path}") == (404, b"not found\n")
    for path in ("/etc/passwd", "/..", "/page/panel.js"):
        assert asked(connection, path)[0] == 404


def test_a_new_state_has_a_new_version_and_no_chunks_of_the_old_one(server):
    server.show(StreamedMap.build(two_panels(600), 300, node_size=100, root_size=100))
    before = server.state.version
    connection = connect(server)
    assert asked(connection, f"/chunks/{before}/0")[0] == 200
    server.show(WholeMap(two_panels(), "wall"), finished=True)
    state = json.loads(asked(connection, "/state")[1])
    assert state["version"] > before and state["finished"]
    assert asked(connection, f"/chunks/{before}/0")[0] == 404
    scene = asked(connection, "/scene")[1]
    header = json.loads(scene[4 : 4 + int.from_bytes(scene[:4], "little")])
    assert (header["version"], header["highlight"]) == (state["version"], "wall")
    server.report("waiting")
    assert json.loads(asked(connection, "/state")[1]) == state | {"message": "waiting"}


PATHS = ("/", "/state", "/scene", "/chunks/1/0", "/nothing")


@pytest.mark.parametrize("path", PATHS)
def test_other_names_of_this_address_are_refused(server, path):
    server.show(WholeMap(two_panels()))
    connection = connect(server)
    for host in ("elsewhere.example", "127.0.0.1.evil.example:80", "192.168.0.1", "localhost.", ""):
        status, content = asked(connection, path, Host=host)
        assert status == 403 and b"--host" in content, host
    for host in ("localhost:80", "127.0.0.1", "[::1]:8080", "[::1]", "LOCALHOST"):
        assert asked(connection, path, Host=host)[0] != 403, host


def test_a_request_names_one_host(server):
    for lines in (b"", b"Host: localhost\r\nHost: elsewhere.example\r\n"):
        connection = idle(server, b"GET /state HTTP/1.1\r\n" + lines + b"\r\n")
        assert connection.recv(20).startswith(b"HTTP/1.1 403"), lines
        connection.close()


@pytest.mark.parametrize("path", PATHS)
def test_other_pages_are_refused(server, path):
    server.show(WholeMap(two_panels()))
    connection = connect(server)
    for headers in (
        {"Origin": "http://elsewhere.example"},
        {"Origin": "null"},
        {"Origin": server.url.replace("http", "https")},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site", "Sec_Fetch_Mode": "no-cors", "Sec_Fetch_Dest": "image"},
        {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate", "Sec_Fetch_Dest": "iframe"},
    ):
        status, content = asked(connection, path, **headers)
        assert status == 403 and b"other pages" in content, headers
    for headers in (
        {"Origin": server.url},
        {"Sec_Fetch_Site": "same-origin"},
        {"Sec_Fetch_Site": "none"},
    ):
        assert asked(connection, path, **headers)[0] != 403, headers


def test_a_link_opens_the_page_but_not_the_map(server):
    server.show(WholeMap(two_panels()))
    link = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}
    connection = connect(server)
    assert asked(connection, "/", **link, Sec_Fetch_Dest="document")[0] == 200
    assert asked(connection, "/scene", **link, Sec_Fetch_Dest="document")[0] == 403


def test_names_of_a_server_for_other_computers(monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "lab7.example.org")
    with bind("0.0.0.0", 0) as bound:
        is_own = own_names(bound, "Maps.example.org")
    own = ("localhost", "192.168.0.7", "::1", "lab7", "lab7.local", "lab7.example.org")
    assert all(map(is_own, (*own, "maps.example.org")))
    assert not any(map(is_own, ("", "evil.example", "lab7.evil.example", "7.example.org")))


def test_answers_cannot_be_embedded(server):
    server.show(WholeMap(two_panels()))
    connection = connect(server)
    for path in ("/", "/state", "/scene"):
        connection.request("GET", path)
        answer = connection.getresponse()
        answer.read()
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert answer.headers["Cross-Origin-Opener-Policy"] == "same-origin"
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert "Access-Control-Allow-Origin" not in answer.headers


def test_the_host_is_not_looked_up(monkeypatch):
    def asks_a_server(*_words: object) -> str:
        raise AssertionError("a name was looked up")

    for name in ("getfqdn", "gethostbyaddr", "gethostbyname"):
        monkeypatch.setattr(socket, name, asks_a_server)
    server = MapServer(bind("0.0.0.0", 0), "0.0.0.0")
    assert asked(connect(server), "/state")[0] == 200
    server.stop()


def test_other_methods_and_bodies_are_refused(server):
    for method, headers, status in (
        ("POST", {"Content-Length": "0"}, 501),
        ("OPTIONS", {"Origin": "http://elsewhere.example"}, 501),
        ("HEAD", {}, 501),
        ("GET", {"Content-Length": "5"}, 400),
        ("GET", {"Transfer-Encoding": "chunked"}, 400),
    ):
        connection = connect(server)
        connection.request(method, "/state", headers=headers)
        held, answer = connection.sock, connection.getresponse()
        assert (answer.status, answer.headers["Connection"]) == (status, "close"), method
        assert ended(held)


def test_what_is_no_request_ends_the_connection(server, caplog):
    for sent in (
        b"\x16\x03\x01\x02\x00" * 20 + b"\r\n\r\n",
        b"GET /state HTTP/9.9\r\n\r\n",
        b"GET /state HTTP/1.1\r\n" + b"A: b\r\n" * 200 + b"\r\n",
        b"GET /" + b"a" * 200_000,
    ):
        connection = idle(server)
        try:
            connection.sendall(sent)
            while connection.recv(4096):
                pass
        except ConnectionError:
            pass
        connection.close()
    assert asked(connect(server), "/state")[0] == 200
    assert not caplog.records


def send_slowly(connection: socket.socket) -> None:
    for _ in range(100):
        connection.sendall(b"A")
        time.sleep(0.05)


def test_a_request_must_arrive_in_time(server, monkeypatch):
    monkeypatch.setattr(connections, "REQUEST_S", 0.3)
    for sent in (b"", b"GET /state HTTP/1.1\r\nHost: localhost"):
        assert ended(idle(server, sent))
    connection = idle(server)
    with pytest.raises(ConnectionError):
        send_slowly(connection)  # each piece in time, but not all of them
    kept = connect(server)
    assert asked(kept, "/state")[0] == 200
    assert ended(kept.sock), "a connection is kept only for some time"


def test_idle_connections_do_not_lock_others_out(server, caplog):
    before = threading.active_count()
    held = [idle(server, b"GET /state HTTP/1.1\r\n"[: 7 * (i % 3)]) for i in range(150)]
    begin_s = time.monotonic()
    assert asked(connect(server), "/state")[0] == 200
    assert time.monotonic() - begin_s < connections.REQUEST_S, "it had to wait for another's end"
    assert threading.active_count() - before <= MAX_CONNECTIONS
    assert all(map(ended, held[:50])), "the oldest are closed first"
    for connection in held:
        connection.close()
    assert not caplog.records


def test_clients_that_do_not_read_do_not_lock_others_out(server):
    class Large(WholeMap):
        def chunk(self, number: int) -> bytes:
            return bytes(8_000_000)

    server.show(Large(two_panels()))
    request = f"GET /chunks/{server.state.version}/0 HTTP/1.1\r\nHost: localhost\r\n\r\n"
    held = [idle(server, request.encode()) for _ in range(MAX_CONNECTIONS)]
    time.sleep(0.5)  # all of them are sent something
    begin_s = time.monotonic()
    assert asked(connect(server), "/state")[0] == 200
    assert time.monotonic() - begin_s < connections.REQUEST_S, "it had to wait for another's end"
    for connection in held:
        connection.close()


def test_without_a_free_thread_connections_are_refused(monkeypatch, caplog):
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 2)
    server, release = MapServer(bind("127.0.0.1", 0)), threading.Event()

    class Slow(WholeMap):
        def chunk(self, number: int) -> bytes:
            release.wait(10.0)
            return b"late"

    server.show(Slow(two_panels()))
    path = f"/chunks/{server.state.version}/0"
    slow = [connect(server), connect(server)]
    for connection in slow:
        connection.request("GET", path)
    time.sleep(0.2)
    assert asked(connect(server), "/state")[0] == 503
    release.set()
    assert [connection.getresponse().read() for connection in slow] == [b"late", b"late"]
    slow[0].close()
    time.sleep(0.2)
    assert asked(connect(server), "/state")[0] == 200
    server.stop()
    assert not caplog.records
