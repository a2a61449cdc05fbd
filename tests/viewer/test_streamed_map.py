"""Streamed maps: the server, what it sends, and the page that loads it, in Chromium."""

from __future__ import annotations

import http.client
import json
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from browser_pages import WatchedPage, chromium, mean_colour
from painted_scenes import two_panels

from toolkit.io.splats import write_splat_ply
from toolkit.runs.splat_clouds import read_cloud
from toolkit.viewer.colouring import CLASSES, SOURCE, SUBMAPS, legend
from toolkit.viewer.html import write_page
from toolkit.viewer.packing import pack_chunk
from toolkit.viewer.scene import ViewerScene
from toolkit.viewer.stream_server import StreamServer
from toolkit.viewer.streaming import StreamedMap, tallies

COUNT, BUDGET = 8_000, 5_000
# Pixels on the table and on the wall, in the first view.
TABLE, WALL = (350, 280), (570, 280)


@pytest.fixture(scope="module")
def shown():
    return StreamedMap.build(scene(), BUDGET, node_size=500, root_size=400)


@pytest.fixture(scope="module")
def server(shown):
    started = StreamServer(shown, "127.0.0.1", 0)
    yield started
    started.stop()


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture
def opened(browser, server):
    watched = WatchedPage(browser, evaluate=True)
    watched.page.goto(f"http://127.0.0.1:{server.get_port()}/")
    completed(watched)
    yield watched
    assert watched.errors == []
    watched.page.close()


def scene() -> ViewerScene:
    """Two panels of many small Gaussians."""
    painted = two_panels(COUNT)
    return replace(painted, splats=replace(painted.splats, sigmas_m=painted.splats.sigmas_m / 3))


def completed(watched: WatchedPage) -> None:
    watched.page.wait_for_selector("#view[data-complete=true]", timeout=60_000)


def moved(watched: WatchedPage, script: str) -> None:
    """Move the camera by a script, and wait until the view is complete."""
    watched.page.evaluate(
        f"{script}; document.getElementById('view').dataset.complete = false;semsplatViewer.moved()"
    )
    completed(watched)


def test_the_server_sends_page_and_chunks_on_one_connection(shown, server):
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    for path, expected in (
        ("/", shown.page),
        ("/chunks/0", pack_chunk(shown.tree.content(0))),
        ("/chunks/3", pack_chunk(shown.tree.content(3))),
    ):
        connection.request("GET", path)
        answer = connection.getresponse()
        assert answer.status == 200 and answer.read() == expected
    for path in (f"/chunks/{len(shown.tree.nodes)}", "/chunks/-1", "/chunks/../x", "/etc/passwd"):
        connection.request("GET", path)
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (404, b"not found\n")
    connection.request("GET", "/chunks/0", headers={"Host": "elsewhere.example"})
    answer = connection.getresponse()
    assert answer.status == 403 and b"not that of the map" in answer.read()


def test_chunks_contain_what_the_page_decodes(shown):
    content = shown.chunk(1)
    length = int.from_bytes(content[:4], "little")
    header = json.loads(content[4 : 4 + length])
    assert length % 4 == 0 and header["count"] == shown.tree.count(1)
    place = header["arrays"]["levels"]
    levels = np.frombuffer(content, place["type"], place["length"], 4 + length + place["offset"])
    assert np.array_equal(levels.reshape(2, -1).T, shown.tree.content(1).levels)
    assert shown.chunk(len(shown.tree.nodes)) is None


def test_tallies_count_like_the_legend():
    few = two_panels(300)
    few.splats.levels[:30, 1] = -1
    counted = tallies(few.splats)
    assert sum(number for _, number in counted["classes"]) == 300
    by_class: dict[int, int] = {}
    for nodes, number in counted["classes"]:
        by_class[nodes[1]] = by_class.get(nodes[1], 0) + number
    expected = sorted(row.fraction for row in legend(few, CLASSES, 1))
    assert sorted(number / 300 for number in by_class.values()) == pytest.approx(expected)
    assert by_class[65535] == 30
    for name, mode in (("submaps", SUBMAPS), ("source", SOURCE)):
        shares = sorted(number / 300 for _, number in counted[name])
        assert shares == pytest.approx(sorted(row.fraction for row in legend(few, mode, 0)))


def test_the_streamed_picture_is_that_of_the_whole_map(opened, browser, server, tmp_path):
    for layer in ("path", "keyframes", "loops"):
        opened.page.uncheck(f"#layer-{layer}")
    opened.page.wait_for_timeout(300)
    streamed = opened.picture()
    write_page(tmp_path / "whole.html", scene())
    whole = WatchedPage(browser)
    whole.page.goto((tmp_path / "whole.html").as_uri())
    whole.page.wait_for_selector("#view[data-frames]")
    for layer in ("path", "keyframes", "loops"):
        whole.page.uncheck(f"#layer-{layer}")
    whole.page.wait_for_timeout(300)
    difference = np.abs(streamed - whole.picture())[:, 300:]
    assert difference.mean() < 6.0 and streamed[:, 300:].max() > 150
    for place in (TABLE, WALL):
        colours = mean_colour(streamed, *place), mean_colour(whole.picture(), *place)
        assert np.abs(colours[0] - colours[1]).max() < 15
    asked = [url for url in opened.requests if not url.startswith(("blob:", "data:"))]
    assert all(url.startswith(f"http://127.0.0.1:{server.get_port()}/") for url in asked)
    assert "8,000 Gaussians, at most 5,000 at once" in opened.page.inner_text("#counts")


def test_classes_legend_search_and_picking_cover_the_map(opened):
    opened.page.get_by_role("radio", name="Classes").click()
    legend_text = opened.page.inner_text("#legend")
    assert "table" in legend_text and "50.0 %" in legend_text
    opened.page.fill("#query", "table")
    assert opened.page.inner_text("#query-result") == "table: 4,000 Gaussians"
    opened.page.wait_for_timeout(500)
    found = opened.picture()
    assert mean_colour(found, *WALL).max() < 0.6 * mean_colour(found, *TABLE).max()
    opened.page.fill("#query", "")
    opened.page.mouse.click(*TABLE)
    assert "furniture > table" in opened.page.inner_text("#picked")
    opened.page.mouse.click(*WALL)
    assert "structure > wall" in opened.page.inner_text("#picked")


def test_the_budget_and_the_memory_are_kept_while_the_view_moves(opened, shown):
    finest = len([node for node in shown.tree.nodes if not node.children])
    for x in (-0.5, 0.5, -0.5):
        moved(
            opened,
            f"Object.assign(semsplatViewer.camera, {{ target: [{x}, 0, 2], distance: 0.3 }})",
        )
        state = opened.page.evaluate(
            """(() => {
              const { shown, nodeCounts, nodeChildren, resident, free } = semsplatViewer.detail;
              const used = [...resident.values()].flatMap(({ blocks }) => blocks);
              const parts = semsplatViewer.scene.parts;
              return {
                leaves: shown.filter((node) => !nodeChildren[2 * node + 1]).length,
                shown: shown.reduce((sum, node) => sum + nodeCounts[node], 0),
                inParts: parts.reduce((sum, [first, end]) => sum + end - first, 0),
                places: used.length + free.length, different: new Set([...used, ...free]).size,
                capacity: semsplatViewer.scene.capacity / 512,
              };
            })()"""
        )
        assert state["shown"] == state["inParts"] <= BUDGET
        assert state["places"] == state["different"] == state["capacity"]
        assert 0 < state["leaves"] < finest, "what is near is shown in full"


def test_a_highlight_is_shown_at_the_start(browser):
    shown = StreamedMap.build(two_panels(600), 300, "wall", node_size=100, root_size=100)
    server = StreamServer(shown, "127.0.0.1", 0)
    watched = WatchedPage(browser)
    try:
        watched.page.goto(f"http://127.0.0.1:{server.get_port()}/")
        completed(watched)
        assert watched.page.inner_text("#query-result") == "wall: 300 Gaussians"
        picture = watched.picture()
        assert mean_colour(picture, *TABLE).max() < 0.6 * mean_colour(picture, *WALL).max()
    finally:
        server.stop()
    assert watched.errors == []


def with_harmonics(run, folder):
    """The map of a run with colours that depend on the direction of view."""
    cloud = read_cloud(run / "map.ply")
    shapes = cloud.ellipsoids
    harmonics = torch.full((len(cloud), 3, 3), 0.1)
    view_dependent = replace(cloud, ellipsoids=replace(shapes, harmonics=harmonics))
    write_splat_ply(folder / "map.ply", view_dependent)
    return folder / "map.ply"


@pytest.mark.parametrize("why", ["size", "harmonics"])
def test_the_program_streams_what_the_other_page_cannot_show(tiny_run, tmp_path, why):
    shown = tiny_run if why == "size" else with_harmonics(tiny_run, tmp_path)
    limit = "300" if why == "size" else "300000"
    words = ["view", str(shown), "--port", "0", "--viewer.max-gaussians", limit]
    with subprocess.Popen(
        [sys.executable, "-m", "toolkit.cli.main", *words, "--budget", "500"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Shells start background jobs, and so the tests in them, with SIGINT ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        try:
            address = process.stdout.readline().strip()
            assert address.startswith("http://127.0.0.1:"), process.stderr.read()
            connection = http.client.HTTPConnection(address.removeprefix("http://"), timeout=10)
            connection.request("GET", "/")
            assert b'"stream":{"budget":' in connection.getresponse().read()
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=20) == 0
        finally:
            process.kill()
        assert "Traceback" not in process.stderr.read()
