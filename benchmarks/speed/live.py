"""`semsplat live --camera replay`: dropped frames, delay and accuracy at ten frames per second.

    SEMSPLAT_DATA=DATA python -m benchmarks.speed.live [--only NAMES]

Run it on an idle machine: the results depend on the time that the machine has for each frame.
"""

from __future__ import annotations

import http.client
import json
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.shared.programs import semsplat, start_semsplat_server
from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, table_of
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.metrics import flattened, read_metrics
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.runs.maps.finished import load_run

FPS = 10
COLUMNS = (
    *("frames.total", "live.frames_dropped", "frames.lost", "frames.keyframes"),
    *("live.captured_fps", "live.delay_median_ms", "live.delay_p95_ms", "live.delay_max_ms"),
    *("trajectory.ate_rmse_cm", "ate_processed_rmse_cm", "images.mapped.psnr_db", "recording_mb"),
    *("viewer_updates", "viewer_mb"),
)
# Not an option of the program: a viewer follows the run.
VIEWER = "viewer"
_LIVE = ("live", "--camera", "replay", "--fps", str(FPS))
_SEQUENCES = {"room": "room", "RedKitchen": "redkitchen"}
# Program and options of each row, before those of its sequence; "--record" has no value here.
ROWS: dict[str, list[str]] = {
    f"{title}, {how}": [sequence, *words]
    for title, sequence in _SEQUENCES.items()
    for how, words in {
        "live": _LIVE,
        "live, --pace": (*_LIVE, "--pace", str(FPS)),
        "live, --pace, viewer attached": (*_LIVE, "--pace", str(FPS), VIEWER),
        "live, --pace, --record": (*_LIVE, "--pace", str(FPS), "--record"),
    }.items()
}
DESCRIPTION = f"""\
Datasets as live cameras: `semsplat live --camera replay --fps {FPS}`. `sequences.md` has
offline runs of the same sequences. The delay is the time from the capture of a frame to its pose,
without dropped frames. `trajectory.ate_rmse_cm` scores all frames, dropped ones at the
last pose before them; `ate_processed_rmse_cm` scores the frames that were processed. Without
`--pace`, each frame is processed completely, and only the newest one waits; with `--pace`,
optimisation is
deferred to the time between the frames. `--record` writes frames, poses, map and times to a file
for the viewer of Rerun. With "viewer attached", `semsplat view --live` follows the run in a process
of its own, on the same machine; its client receives what the page in a browser would and draws
nothing. `viewer_updates` counts the states of the growing map that were shown. RedKitchen and
the synthetic room have 320x240 pixels. Live runs depend on the speed and the load of the machine
and are not reproducible."""


# The page asks every second.
_POLL_S, _ASK_S = 0.05, 1.0
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
        _receive(url.removeprefix("http://"), load, ended)
    finally:
        server.send_signal(signal.SIGINT)
        messages = server.communicate()[1].splitlines()
    load.updates = sum(m.startswith(_SHOWN) and _OF_A_FRAME in m for m in messages)


def _receive(address: str, load: ViewerLoad, ended: threading.Event) -> None:
    version = 0
    while not ended.wait(_ASK_S):
        state = json.loads(_content(address, "/state"))
        if state["version"] != version:
            version = state["version"]
            load.received_mb += len(_content(address, "/scene")) / 1e6


def _content(address: str, path: str) -> bytes:
    connection = http.client.HTTPConnection(address, timeout=60.0)
    with closing(connection):
        connection.request("GET", path)
        return connection.getresponse().read()


def measure(job: list[str], seed: int) -> Metrics:
    """Run one sequence."""
    sequence, program, *words = job
    with tempfile.TemporaryDirectory() as temporary:
        out, record = Path(temporary) / "run", Path(temporary) / "run.rrd"
        words += [str(record)] if words[-1:] == ["--record"] else []
        options = [*sequence_arguments(sequence), *(word for word in words if word != VIEWER)]
        with attached_viewer(out) if VIEWER in words else nullcontext() as viewer:
            semsplat(program, *options, "--seed", str(seed), "--out", str(out))
        metrics = flattened(read_metrics(out / "metrics.json"))
        metrics["ate_processed_rmse_cm"] = _processed_error_cm(out)
        metrics["viewer_updates"] = viewer and viewer.updates
        metrics["viewer_mb"] = viewer and viewer.received_mb
        metrics["recording_mb"] = record.stat().st_size / 1e6 if record.exists() else None
    return metrics


def _processed_error_cm(out: Path) -> float | None:
    """ATE of the frames that were processed; None without ground truth."""
    run = load_run(out)
    truth = run.open_dataset().ground_truth
    if truth is None:
        return None
    dropped = json.loads((out / "frames.json").read_text(encoding="utf-8")).get("dropped", [])
    frames = [frame for frame in run.tracked if frame.index not in set(dropped)]
    times_s = np.array([frame.timestamp_s for frame in frames])
    estimate = Trajectory(times_s, np.array([frame.T_map_camera for frame in frames]))
    return 100.0 * absolute_trajectory_error(estimate, truth).rmse_m


PAGE = Page(
    "live",
    "Live cameras",
    DESCRIPTION,
    ROWS,
    measure,
    lambda rows: [table_of(COLUMNS, rows, "sequence")],
)

if __name__ == "__main__":
    PAGE.main()
