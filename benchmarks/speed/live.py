"""`semsplat live --camera replay`: dropped frames, delay and accuracy at ten frames per second.

    SEMSPLAT_DATA=DATA python -m benchmarks.speed.live [--only NAMES]

Run it on an idle machine: the results depend on the time that the machine has for each frame.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from benchmarks.shared.programs import semsplat
from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, table_of
from benchmarks.speed.attached_viewer import attached_viewer
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
Datasets as live cameras: `semsplat live --camera replay --fps {FPS}`. The files `sequences` and
`pace` have offline runs of the same sequences. The delay is the time from the capture of a frame to
its pose, without dropped frames. `trajectory.ate_rmse_cm` scores all frames, dropped ones at the
last pose before them; `ate_processed_rmse_cm` scores the frames that were processed. Without
`--pace`, each frame is processed completely, and only the newest one waits; with `--pace`,
optimisation is
deferred to the time between the frames. `--record` writes frames, poses, map and times to a file
for the viewer of Rerun. With "viewer attached", `semsplat view --live` follows the run in a process
of its own, on the same machine; its client receives what the page in a browser would and draws
nothing. `viewer_updates` counts the states of the growing map that were shown. RedKitchen and
the synthetic room have 320x240 pixels. Live runs depend on the speed and the load of the machine
and are not reproducible."""


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
