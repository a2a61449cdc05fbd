"""`semsplat view` as a process, and its one line for what cannot be shown."""

from __future__ import annotations

import http.client
import json
import shutil
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from programs import MAIN, start

from toolkit.io.splats import write_splat_ply
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.tools.cli.main import main


@contextmanager
def viewer(*words: object) -> Iterator[http.client.HTTPConnection]:
    """A connection to the program, which is interrupted at the end of the block."""
    with start("-m", MAIN, "view", *words, "--port", 0) as process:
        try:
            address = process.stdout.readline().strip()
            assert address.startswith("http://127.0.0.1:"), process.stderr.read()
            yield http.client.HTTPConnection(address.removeprefix("http://"), timeout=10)
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=20) == 0
        finally:
            process.kill()
        assert "Traceback" not in process.stderr.read()


def content(connection: http.client.HTTPConnection, path: str) -> bytes:
    connection.request("GET", path)
    answer = connection.getresponse()
    assert answer.status == 200
    return answer.read()


def header(scene: bytes) -> dict:
    """The header of a scene that was sent."""
    return json.loads(scene[4 : 4 + int.from_bytes(scene[:4], "little")])


def with_harmonics(run: Path, folder: Path) -> Path:
    """The map of a run with colours that depend on the direction of view."""
    cloud = read_cloud(run / "map.ply")
    harmonics = torch.full((len(cloud), 3, 3), 0.1)
    shapes = replace(cloud.ellipsoids, harmonics=harmonics)
    write_splat_ply(folder / "map.ply", replace(cloud, ellipsoids=shapes))
    return folder / "map.ply"


def test_a_small_map_is_sent_whole(tiny_run, tmp_path):
    with viewer(with_harmonics(tiny_run, tmp_path)) as connection:
        assert b"<canvas" in content(connection, "/")
        scene = header(content(connection, "/scene"))
        assert "stream" not in scene and scene["count"] == scene["total"]
        assert "harmonics" in scene["arrays"]
        state = json.loads(content(connection, "/state"))
        assert state == {"version": scene["version"], "finished": True, "message": ""}


def test_a_large_map_is_streamed(tiny_run):
    with viewer(tiny_run, "--viewer.max-gaussians", 300, "--budget", 500) as connection:
        scene = header(content(connection, "/scene"))
        assert scene["stream"]["budget"] >= 500 and scene["total"] > 300
        assert content(connection, f"/chunks/{scene['version']}/0")


def test_a_finished_run_can_be_followed(tiny_run):
    with viewer(tiny_run, "--live", "--highlight", "wall") as connection:
        state = {"finished": False}
        while not state["finished"]:
            state = json.loads(content(connection, "/state"))
        assert state["message"] == "The run is finished."
        scene = header(content(connection, "/scene"))
        assert scene["title"] == "run" and scene["highlight"] == "wall"


def error_line(capsys, *words: object) -> str:
    assert main(["view", *map(str, words)]) != 0
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_a_port_in_use_is_reported(tiny_run, capsys):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        line = error_line(capsys, tiny_run, "--port", port)
        assert f"port {port} of 127.0.0.1 is in use" in line and "--port" in line


def test_an_address_of_another_machine_is_reported(tiny_run, capsys):
    assert "--host" in error_line(capsys, tiny_run, "--host", "192.0.2.1", "--port", 0)


def test_an_unknown_class_is_reported(tiny_run, capsys):
    line = error_line(capsys, tiny_run, "--port", 0, "--highlight", "unicorn")
    assert "--highlight unicorn" in line


def unfinished(run: Path) -> None:
    (run / "map.ply").unlink()
    (run / "metrics.json").unlink()


def without_map(run: Path) -> None:
    (run / "map.ply").unlink()


def truncated(run: Path) -> None:
    content = (run / "map.ply").read_bytes()
    (run / "map.ply").write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (unfinished, "not finished"),
        (without_map, "ended without a map"),
        (truncated, "truncated"),
    ],
)
def test_bad_folders_are_reported_in_one_line(tiny_run, tmp_path, capsys, damage, words):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    damage(run)
    assert words in error_line(capsys, run, "--port", 0)
