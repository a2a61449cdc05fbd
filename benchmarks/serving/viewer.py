"""Times the viewer in headless Chromium with software WebGL.

    python -m benchmarks.serving.viewer

Needs chromium (apt-get install chromium), and playwright from pip.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import sync_playwright

from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, table_of, targets_of
from toolkit.base.geometry.camera import Camera
from toolkit.io.addresses import bind
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.viewer.html import write_page
from toolkit.tools.viewer.scene import ShownKeyframe, ShownSplats, ShownTree, ViewerScene
from toolkit.tools.viewer.server import MapServer
from toolkit.tools.viewer.streaming import WholeMap

MEASURES = ("toolkit/tools/viewer",)
FLAGS = (
    *("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    "--ignore-gpu-blocklist",
)
SIZE = {"width": 1280, "height": 720}
COUNTS, TARGET_S = (100_000, 300_000, 500_000), 10.0
COLUMNS = (
    *("file MB", "written s", "page drawn s", "turned s", "level s", "server drawn s"),
    "next state s",
)
# A picture is drawn when this share of its middle is brighter than the background, but not white as
# an empty page.
DRAWN_SHARE, BACKGROUND, WHITE = 0.25, 40, 250
DESCRIPTION = """\
A room of 6 x 3 x 5 m, seen from inside, whose six sides are covered by isotropic Gaussians with
three classes; every Gaussian covers its share of the surface. The window has 1280x720 pixels. Time
until drawn starts with opening the page and ends with a screenshot in which the room is visible;
that of the local server includes the transfer to the browser, but not the start of Python. A turned
view includes sorting and a screenshot, a change of the level the new colours, legend and a
screenshot. The next state is the time from the next state of a served map, as of a run in progress,
until a page that shows the one before has drawn it; the page asks for it every second. Medians of
the repetitions. Software rendering (SwiftShader) on the processor."""


@contextmanager
def chromium() -> Iterator[Any]:
    """A headless browser.

    Raises:
        SystemExit: it is missing.
    """
    executable = shutil.which("chromium")
    if executable is None:
        raise SystemExit("chromium is missing; run: apt-get install chromium")
    with sync_playwright() as session:
        browser = session.chromium.launch(executable_path=executable, args=list(FLAGS))
        yield browser
        browser.close()


def room(count: int, seed: int) -> ViewerScene:
    """Return a room whose sides are covered by Gaussians, with three classes."""
    rng = np.random.default_rng(seed)
    size_m = np.array([6.0, 3.0, 5.0])
    areas = np.repeat([size_m[1] * size_m[2], size_m[0] * size_m[2], size_m[0] * size_m[1]], 2)
    side = rng.choice(6, count, p=areas / areas.sum())
    means_m = (rng.random((count, 3)) - 0.5) * size_m
    axis = side // 2
    means_m[np.arange(count), axis] = np.where(side % 2, 0.5, -0.5) * size_m[axis]
    stripes = 128 + 100 * np.sin(8.0 * means_m + axis[:, None])
    taxonomy = Taxonomy.from_json(
        {
            "name": "room",
            "levels": ["group", "class"],
            "classes": ["wall", "floor", "front"],
            "tree": {"structure": ["wall", "floor"], "other": ["front"]},
        }
    )
    splats = ShownSplats(
        means_m=means_m.astype(np.float32),
        sigmas_m=np.full(count, np.sqrt(areas.sum() / count), np.float32),
        opacities=rng.uniform(0.5, 0.95, count).astype(np.float32),
        rgb=np.clip(stripes, 60, 255).astype(np.uint8),
        levels=taxonomy.node_ids[axis].astype(np.int32),
        confidence=rng.random(count).astype(np.float32),
    )
    keyframe = ShownKeyframe(0, np.eye(4))
    camera = Camera(256.0, 256.0, 159.5, 119.5, 320, 240)
    tree = ShownTree.from_taxonomy(taxonomy)
    return ViewerScene("room", splats, count, tree=tree, keyframes=(keyframe,), camera=camera)


def measure(count: int, seed: int) -> Metrics:
    """Times of a room with a number of Gaussians."""
    scene = room(count, seed)
    with chromium() as browser, tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "viewer.html"
        written_s = _seconds(lambda: write_page(file, scene))
        page = browser.new_page(viewport=SIZE, bypass_csp=True)
        times = {
            "page drawn s": _seconds(lambda: _open(page, file.as_uri())),
            "turned s": _seconds(lambda: _turn(page)),
            "level s": _seconds(lambda: _change_level(page)),
        }
        page.close()
        server_s, next_s = _measure_server(browser, scene)
        size_mb = file.stat().st_size / 1e6
    start = {"file MB": size_mb, "written s": written_s}
    return start | times | {"server drawn s": server_s, "next state s": next_s}


def _measure_server(browser: Any, scene: ViewerScene) -> tuple[float, float]:
    """Return the times until a served map is drawn, and its next state."""
    server = MapServer(bind("127.0.0.1", 0))
    server.show(WholeMap(scene))
    page = browser.new_page(viewport=SIZE)
    try:
        drawn_s = _seconds(lambda: _open(page, server.url))
        return drawn_s, _seconds(lambda: _show_next(server, scene, page))
    finally:
        page.close()
        server.stop()


def _show_next(server: MapServer, scene: ViewerScene, page: Any) -> None:
    server.show(WholeMap(scene), finished=True)
    page.wait_for_selector(f"#view[data-version='{server.state.version}']")


def _open(page: Any, url: str) -> None:
    page.goto(url)
    while not _is_drawn(_picture(page)):
        page.wait_for_timeout(20)


def _turn(page: Any) -> None:
    frames = int(page.get_attribute("#view", "data-frames"))
    page.evaluate("semsplatViewer.camera.turn(0.4, 0, true); semsplatViewer.moved()")
    page.wait_for_selector(f"#view:not([data-frames='{frames}'])")
    _picture(page)


def _change_level(page: Any) -> None:
    page.locator("#level-slider").fill("0")
    _picture(page)


def _picture(page: Any) -> NDArray[np.uint8]:
    content = np.frombuffer(page.screenshot(type="jpeg"), np.uint8)
    picture: NDArray[np.uint8] = cv2.imdecode(content, cv2.IMREAD_COLOR)
    return picture


def _is_drawn(picture: NDArray[np.uint8]) -> bool:
    # Beside the panel.
    middle = picture[200:, 320:900]
    shown = (middle.max(axis=2) > BACKGROUND) & (middle.min(axis=2) < WHITE)
    return float(shown.mean()) > DRAWN_SHARE


def _seconds(step: Callable[[], object]) -> float:
    begin = time.perf_counter()
    step()
    return time.perf_counter() - begin


_DRAWN = f"page of {COUNTS[-1]:,} Gaussians drawn (s)", f"{COUNTS[-1]:,}", "page drawn s", TARGET_S
PAGE = Page(
    "viewer",
    "Viewer in the browser",
    DESCRIPTION,
    {f"{count:,}": count for count in COUNTS},
    measure,
    lambda rows: [table_of(COLUMNS, rows, "Gaussians")],
    lambda rows: targets_of(rows, at_most=[_DRAWN]),
    seeds=3,
    measures=MEASURES,
)

if __name__ == "__main__":
    PAGE.main()
