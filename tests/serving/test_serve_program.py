"""`semsplat serve` as users start it, and its one line for what cannot be served."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2 as httpx
import pytest
from programs import MAIN, start

from toolkit.io.addresses import bind, is_local
from toolkit.tools.cli.main import main


@contextmanager
def service(*words: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A service in a process of its own, and its URL; it is ended with the block."""
    process = start("-m", MAIN, "serve", *words, "--port", 0)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("serving "), process.stderr.read() if process.stderr else ""
        yield process, line.split(" at ")[1].split(";")[0]
    finally:
        process.kill()
        process.communicate()


def error_line(capsys, *words: object) -> str:
    """The line of a call that must fail."""
    assert main(["serve", *map(str, words)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_a_service_answers_over_http_and_ends_with_ctrl_c(tiny_run: Path):
    with service(tiny_run) as (process, url):
        assert url.startswith("http://127.0.0.1:")
        with httpx.Client(base_url=url) as client:
            assert client.get("run").json()["frames"] == 6
            assert client.get("keyframes/0.png").content.startswith(b"\x89PNG")
            assert client.post("render", content=b" " * 100_000).status_code == 413
            assert client.post("render", content=iter([b"{}"])).status_code == 411
        _send_garbage(url)
        assert httpx.get(url).status_code == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
        assert process.returncode == 0
        assert "Traceback" not in errors


def _send_garbage(url: str) -> None:
    """Send bytes that are not HTTP, and a request that ends early."""
    host, port = url.removeprefix("http://").rstrip("/").split(":")
    for content in (
        b"\x16\x03\x01\x02\x00" * 50,
        b"POST /render HTTP/1.1\r\nContent-Length: 9\r\n\r\n{",
    ):
        with socket.create_connection((host, int(port)), timeout=5) as connection:
            connection.sendall(content)
            connection.shutdown(socket.SHUT_WR)
            time.sleep(0.05)


def test_a_port_in_use_is_reported_in_one_line(tiny_run: Path, capsys):
    with bind("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        assert f"port {port} of 127.0.0.1 is in use" in error_line(capsys, tiny_run, "--port", port)


def test_another_address_is_warned_of_in_one_line(tiny_run: Path):
    with service(tiny_run, "--host", "0.0.0.0") as (process, url):
        assert httpx.get(f"{url}run", headers={"Host": "map.example"}).status_code == 200
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    (line,) = errors.strip().splitlines()
    assert "Anyone who can connect to 0.0.0.0 can read the map" in line


def test_addresses_of_this_machine_are_recognised():
    assert [is_local(h) for h in ("localhost", "127.1.2.3", "::1", "::", "0.0.0.0", "a.b")] == [
        *(True, True, True, False, False, False)
    ]


def test_addresses_of_other_machines_are_rejected(tiny_run: Path, capsys):
    line = error_line(capsys, tiny_run, "--host", "192.0.2.1")
    assert "192.0.2.1" in line
    assert "--port" in error_line(capsys, tiny_run, "--port", "70000")


@pytest.mark.parametrize("missing", ["config.yaml", "map.ply", "trajectory.txt", "frames.json"])
def test_incomplete_runs_are_rejected(tiny_run: Path, tmp_path: Path, capsys, missing: str):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    (run / missing).unlink()
    assert missing in error_line(capsys, run, "--port", 0)


def test_damaged_runs_are_rejected(tiny_run, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    frames = json.loads((run / "frames.json").read_text())
    # As if a resumed run were writing its results.
    (run / "frames.json").write_text(json.dumps(frames | {"frames": frames["frames"][:-1]}))
    assert "frames.json" in error_line(capsys, run, "--port", 0)
    line = error_line(capsys, tmp_path / "nothing", "--port", 0)
    assert "contains no run: it does not exist" in line


def test_missing_packages_are_named(tiny_run: Path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "fastapi", None)
    monkeypatch.delitem(sys.modules, "toolkit.tools.serving.application", raising=False)
    assert "pip install 'semsplat[server]'" in error_line(capsys, tiny_run, "--port", 0)
