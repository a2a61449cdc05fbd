"""Streamed maps: what the server sends, and the page that loads it, in Chromium."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from browser_pages import WatchedPage, chromium, mean_colour
from painted_scenes import two_panels

from toolkit.io.addresses import bind
from toolkit.tools.viewer.html import write_page
from toolkit.tools.viewer.scene import ViewerScene
from toolkit.tools.viewer.server import MapServer
from toolkit.tools.viewer.streaming import StreamedMap, tallies

COUNT, BUDGET = 8_000, 5_000
# Pixels on the table and on the wall, in the first view.
TABLE, WALL = (350, 280), (570, 280)


@pytest.fixture(scope="module")
def shown():
    return StreamedMap.build(scene(), BUDGET, node_size=500, root_size=400)


@pytest.fixture(scope="module")
def server(shown):
    started = MapServer(bind("127.0.0.1", 0))
    started.show(shown, finished=True)
    yield started
    started.stop()


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture
def opened(browser, server):
    watched = WatchedPage(browser, evaluate=True)
    watched.page.goto(server.url)
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


def test_chunks_contain_what_the_page_decodes(shown):
    content = shown.chunk(1)
    length = int.from_bytes(content[:4], "little")
    header = json.loads(content[4 : 4 + length])
    assert length % 4 == 0 and header["count"] == shown.tree.count(1)
    place = header["arrays"]["levels"]
    levels = np.frombuffer(content, place["type"], place["length"], 4 + length + place["offset"])
    assert np.array_equal(levels.reshape(2, -1).T, shown.tree.content(1).levels)
    assert shown.chunk(len(shown.tree.nodes)) is None


def test_tallies_count_paths_submaps_and_sources():
    few = two_panels(300)
    few.splats.levels[:30, 1] = -1
    furniture, table = few.splats.levels[100]
    structure, wall = few.splats.levels[101]
    assert tallies(few.splats) == {
        "classes": [
            [[furniture, 65535], 15],
            [[furniture, table], 135],
            [[structure, 65535], 15],
            [[structure, wall], 135],
        ],
        "submaps": [[0, 150], [1, 150]],
        "source": [[0, 150], [1, 150]],
    }


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
    assert all(url.startswith(f"{server.url}/") for url in asked)
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
    server = MapServer(bind("127.0.0.1", 0))
    server.show(shown, finished=True)
    watched = WatchedPage(browser)
    try:
        watched.page.goto(server.url)
        completed(watched)
        assert watched.page.inner_text("#query-result") == "wall: 300 Gaussians"
        picture = watched.picture()
        assert mean_colour(picture, *TABLE).max() < 0.6 * mean_colour(picture, *WALL).max()
    finally:
        server.stop()
    assert watched.errors == []
