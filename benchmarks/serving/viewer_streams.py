"""Times the streamed levels of detail of `semsplat view` in headless Chromium with software WebGL.

    python -m benchmarks.serving.viewer_streams

Needs chromium (apt-get install chromium), and playwright from pip.
"""

from __future__ import annotations

import signal
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.serving.viewer import MEASURES, SIZE, chromium
from benchmarks.shared.programs import start_semsplat_server
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, table_of, targets_of
from toolkit.io.splats import Splats, write_splat_ply

COUNTS, TARGET_S = (1_000_000, 10_000_000), 3.0
COLUMNS = (
    *("file MB", "ready s", "first picture s", "complete s", "sent MB", "close s"),
    *("page memory MB", "graphics memory MB", "frame ms", "Gaussians in motion"),
)

# Gaussians of a room, whose walls are 3 m high, and the share of its place that it takes.
_PER_ROOM, _SHARE = 250_000, 0.97
_ROOM_M = np.array([6.0, 3.0, 5.0])
_TIMEOUT_MS = 300_000
_TURNS_S = 15.0
DESCRIPTION = """\
A file with a building of rooms of 250,000 Gaussians each, without ceilings, seen from above, with
at most 1,000,000 Gaussians at once. The window has 1280x720 pixels. Ready is the time from the
start of the program to its address. First picture, complete view and the data sent for it are
counted from opening the page. A view is complete when all is loaded that the graphics can draw in
about 1.5 s, which in software is fewer than 1,000,000 Gaussians. Close is the time until the view
is complete again after moving to the middle of one room. Memory is that of the page and of the
graphics process, which holds textures and renders in software here. Frames are those of a turning
view in this room after 15 s, when the numbers of Gaussians and of pixels have followed the time per
frame. Software rendering (SwiftShader) on the processor."""


def building(count: int) -> Splats:
    """Return rooms side by side, each with walls and floor of its own colour."""
    rng = np.random.default_rng(0)
    room = np.arange(count) // _PER_ROOM
    across = int(np.ceil(np.sqrt(room[-1] + 1)))
    areas = _ROOM_M[[1, 1, 0, 0, 0]] * _ROOM_M[[2, 2, 1, 1, 2]]
    side = rng.choice(5, count, p=areas / areas.sum())
    axis, end = np.array([0, 0, 2, 2, 1])[side], np.array([-0.5, 0.5, -0.5, 0.5, 0.5])[side]
    places = rng.random((count, 3)) - 0.5
    places[np.arange(count), axis] = end
    corner = np.stack([room % across, np.zeros(count), room // across], axis=1)
    stripes = 0.5 + 0.3 * np.sin(5.0 * places * _ROOM_M + axis[:, None] + room[:, None] * [1, 2, 3])
    size_m = np.sqrt(areas.sum() / min(count, _PER_ROOM))
    return Splats(
        means=((_SHARE * places + corner) * _ROOM_M).astype(np.float32),
        log_radii=np.full(count, np.log(size_m), np.float32),
        opacity_logits=rng.uniform(0.0, 3.0, count).astype(np.float32),
        colours=stripes.astype(np.float32),
    )


def measure(count: int, _seed: int) -> Metrics:
    """Times, data and memory of a building with a number of Gaussians."""
    with chromium() as browser, tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "building.ply"
        write_splat_ply(file, building(count))
        return _measure(browser, file)


def _measure(browser: Any, file: Path) -> Metrics:
    begin = time.perf_counter()
    server, url = start_semsplat_server("view", str(file), "--port", "0")
    ready_s = time.perf_counter() - begin
    page = browser.new_page(viewport=SIZE, bypass_csp=True)
    page.set_default_timeout(_TIMEOUT_MS)
    try:
        begin = time.perf_counter()
        page.goto(url)
        page.wait_for_selector("#view[data-frames]")
        first_s = time.perf_counter() - begin
        page.wait_for_selector("#view[data-complete=true]")
        complete_s = time.perf_counter() - begin
        sent_mb = page.evaluate("semsplatViewer.detail.loadedBytes / 1e6")
        sent_mb += page.evaluate("performance.getEntriesByType('navigation')[0].transferSize / 1e6")
        close_s = _move_into_a_room(page)
        memory = {kind: _memory_mb(kind) for kind in ("renderer", "gpu-process")}
        frame_ms, moving = _turn(page)
    finally:
        page.close()
        server.send_signal(signal.SIGINT)
        server.communicate()
    return {
        "file MB": file.stat().st_size / 1e6,
        "ready s": ready_s,
        "first picture s": first_s,
        "complete s": complete_s,
        "sent MB": sent_mb,
        "close s": close_s,
        "page memory MB": memory["renderer"],
        "graphics memory MB": memory["gpu-process"],
        "frame ms": frame_ms,
        "Gaussians in motion": moving,
    }


def _move_into_a_room(page: Any) -> float:
    begin = time.perf_counter()
    page.evaluate(
        "Object.assign(semsplatViewer.camera, { target: [0, 0, 1], distance: 1, pitch: 0 });"
        "document.getElementById('view').dataset.complete = false; semsplatViewer.moved()"
    )
    page.wait_for_selector("#view[data-complete=true]")
    return time.perf_counter() - begin


def _turn(page: Any) -> tuple[float, float]:
    """Turn for some seconds; return the time per frame at the end, and the Gaussians drawn."""
    result = page.evaluate(
        """async (seconds) => {
          const viewer = semsplatViewer, begin = performance.now(), frames = [];
          let last = 0;
          while (performance.now() < begin + 1000 * seconds) {
            viewer.camera.turn(0.01, 0, true);
            viewer.moved();
            await new Promise(requestAnimationFrame);
            if (viewer.pace.frameMs !== last) frames.push(last = viewer.pace.frameMs);
          }
          const end = frames.slice(-10).sort((a, b) => a - b);
          return [end[Math.floor(end.length / 2)], viewer.splats.visible];
        }""",
        _TURNS_S,
    )
    return float(result[0]), float(result[1])


def _memory_mb(kind: str) -> float:
    """Return the memory of the largest process of the browser of this kind (Linux)."""
    sizes = [0.0]
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if f"--type={kind}" not in (process / "cmdline").read_text():
                continue
            lines = (process / "smaps_rollup").read_text().splitlines()
        except OSError:  # it has ended, or belongs to someone else
            continue
        sizes += [float(line.split()[1]) / 1e3 for line in lines if line.startswith("Pss:")]
    return max(sizes)


_FIRST = f"first picture of {COUNTS[0]:,} Gaussians (s)", f"{COUNTS[0]:,}"
PAGE = Page(
    "viewer-streams",
    "Streamed maps in the browser",
    DESCRIPTION,
    {f"{count:,}": count for count in COUNTS},
    measure,
    lambda rows: [table_of(COLUMNS, rows, "Gaussians")],
    lambda rows: targets_of(rows, at_most=[(*_FIRST, "first picture s", TARGET_S)]),
    measures=MEASURES,
)

if __name__ == "__main__":
    PAGE.main()
