"""`semsplat view`: the local server, in Chromium and as a process."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from browser_pages import WatchedPage, chromium
from painted_scenes import two_panels

from toolkit.cli.main import main
from toolkit.errors import SettingsError
from toolkit.viewer.colouring import COLOUR, appearance
from toolkit.viewer.live import LiveRun
from toolkit.viewer.options import ShownContent
from toolkit.viewer.scene import ViewerScene
from toolkit.viewer.server import MapServer, start_viser, stop_viser
from toolkit.viewer.server_scene import covariances

pytest.importorskip("viser")

# viser's client computes the bounds of its own, not yet filled buffer.
KNOWN = "computeBoundingSphere"
# Above, viser notes that WebGL is rendered by software.
TOP = 170


@pytest.fixture
def server():
    started = start_viser("127.0.0.1", 0)
    yield started
    stop_viser(started)


def test_the_page_of_the_server_shows_and_picks(server):
    shown = MapServer(server)
    shown.show(two_panels())
    with chromium() as browser:
        watched = WatchedPage(browser)
        page = watched.page
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        page.get_by_text("400 of 800 Gaussians").wait_for(timeout=30_000)
        empty = np.array([13, 16, 21])
        for _ in range(100):
            page.wait_for_timeout(100)
            coloured = np.abs(watched.picture()[TOP:, :560] - empty).max(axis=2) > 60
            if coloured.sum() > 2000:
                break
        assert coloured.sum() > 2000, "no Gaussians are drawn"
        before = watched.picture()
        page.get_by_role("slider").first.focus()
        page.keyboard.press("ArrowLeft")
        page.get_by_text("1 of 2:").wait_for()
        page.get_by_text("furniture", exact=True).first.wait_for()
        for _ in range(50):
            page.wait_for_timeout(100)
            if (np.abs(watched.picture() - before)[TOP:, :560].max(axis=2) > 30).sum() > 500:
                break
        else:
            pytest.fail("the level does not change the colours")
        page.mouse.click(400, 300)
        page.get_by_text("position").wait_for(timeout=10_000)
        body = page.inner_text("body")
        assert "furniture > table" in body or "structure > wall" in body
        asked = [u for u in watched.requests if not u.startswith(("data:", "blob:"))]
        assert [u for u in asked if not u.startswith("http://127.0.0.1:")] == []
        assert [e for e in watched.errors if KNOWN not in e] == []


def test_a_scene_is_replaced(server, monkeypatch):
    nodes = []
    add = server.scene.add_gaussian_splats
    monkeypatch.setattr(
        server.scene, "add_gaussian_splats", lambda *args: nodes.append(add(*args)) or nodes[-1]
    )
    scene = two_panels()
    shown = MapServer(server)
    shown.show(scene)
    smaller = ViewerScene("later", scene.splats.select(np.arange(10)), 10, tree=scene.tree)
    shown.show(smaller)
    (node,) = nodes  # browsers keep their view of a node, which another one would lose
    assert np.array_equal(node.centers, smaller.splats.means_m)
    assert np.array_equal(node.rgbs, appearance(smaller, COLOUR, 0).rgb)


def test_covariances_of_the_server():
    scene = two_panels(4)
    assert covariances(scene)[0] == pytest.approx(0.06**2 * np.eye(3))


def test_a_port_in_use_is_an_error():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(SettingsError, match=f"port {port} .*in use.*--port"):
            start_viser("127.0.0.1", port)


def test_an_address_of_another_machine_is_an_error():
    with pytest.raises(SettingsError, match="--host"):
        start_viser("192.0.2.1", 0)


def test_the_program_serves_on_localhost_until_interrupted(tiny_run):
    command = [sys.executable, "-m", "toolkit.cli.main", "view", str(tiny_run), "--port", "0"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Shells start background jobs, and so the tests in them, with SIGINT ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        try:
            address = process.stdout.readline().strip()
            assert address.startswith("http://127.0.0.1:"), process.stderr.read()
            with urllib.request.urlopen(address, timeout=10) as answer:
                assert answer.status == 200
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=20) == 0
        finally:
            process.kill()
        assert "Traceback" not in process.stderr.read()


def unfinished(run: Path) -> None:
    (run / "map.ply").unlink()
    (run / "metrics.json").unlink()


def without_map(run: Path) -> None:
    (run / "map.ply").unlink()


def of_another_version(run: Path) -> None:
    with (run / "config.yaml").open("a") as file:
        file.write("setting_of_the_future: 1\n")


def truncated(run: Path) -> None:
    content = (run / "map.ply").read_bytes()
    (run / "map.ply").write_bytes(content[: len(content) // 2])


def test_an_unknown_class_is_reported(tiny_run, capsys):
    assert main(["view", str(tiny_run), "--port", "0", "--highlight", "unicorn"]) != 0
    assert "--highlight unicorn" in capsys.readouterr().err


def test_a_server_follows_a_run_until_it_is_finished(server, tiny_run, resumable_run, tmp_path):
    """The run has saved its last checkpoint; its results appear while the server waits."""
    running = tmp_path / "running"
    shutil.copytree(resumable_run, running)
    (running / "map.ply").unlink()
    waits = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 2:
            shutil.copy(tiny_run / "map.ply", running)

    live = LiveRun(running, ShownContent())
    MapServer(server).follow(live, wait)
    assert live.finished and len(waits) == 2


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (unfinished, "not finished"),
        (without_map, "ended without a map"),
        (of_another_version, "setting_of_the_future"),
        (truncated, "truncated"),
    ],
)
def test_bad_folders_are_reported_in_one_line(tiny_run, tmp_path, capsys, damage, words):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    damage(run)
    assert main(["view", str(run), "--port", "0"]) != 0
    message = capsys.readouterr().err.strip().splitlines()
    assert len(message) == 1 and words in message[0]
