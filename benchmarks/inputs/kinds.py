"""Recordings as people have them: what the toolkit makes of each kind.

    python -m benchmarks.inputs.kinds [--only 'given poses in UTM']

Every input is made on the spot (`kind_rooms`). What readers make of files, tests say.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.inputs.kind_rooms import FRAMES, KINDS, Kind, write_room
from benchmarks.shared.programs import finished_semsplat
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, table_of
from toolkit.runs.evaluation.metrics import flattened, read_metrics

DESCRIPTION = f"""\
A synthetic room ({FRAMES} frames, 160x120) in the form of each kind of recording. Good maps have
the PSNR of their mapped views, the ATE relative to the size of the scene, and lost frames;
otherwise, the last line of the message. "reported" marks runs that report a defect of the data,
"worse than its images allow" those that say so of the map."""
_MAX_MESSAGE = 160


def measure(name: str, _seed: int) -> Metrics:
    """What is right, and one line about what the toolkit makes of a kind."""
    kind = KINDS[name]
    with tempfile.TemporaryDirectory() as temporary:
        folder, out = Path(temporary) / "mine", Path(temporary) / "out"
        write_room(folder, kind.change)
        kind.after(folder)
        words = [word.replace("FOLDER", str(folder)) for word in kind.job]
        done = finished_semsplat(*words, "--out", str(out))
        metrics = out / "metrics.json"
        if done.returncode == 0 and metrics.exists():
            found = _map_line(flattened(read_metrics(metrics)), kind, done.stderr)
        else:
            lines = (done.stdout + done.stderr).strip().splitlines() or [""]
            message = lines[-1].replace(temporary, "").removeprefix("semsplat: error: ")
            found = f"status {done.returncode}: {message[:_MAX_MESSAGE]}".replace("|", "/")
    return {"right": kind.right, "found": found}


def _map_line(metrics: Mapping[str, Any], kind: Kind, log: str) -> str:
    ate_cm, psnr_db = metrics["trajectory.ate_rmse_cm"], metrics["images.mapped.psnr_db"]
    ate = "" if ate_cm is None else f", ATE {ate_cm / kind.scale:.2f} cm"
    lost = metrics["frames.lost"] + (metrics.get("frames.doubtful") or 0)
    psnr = "no view" if psnr_db is None else f"{psnr_db:.1f} dB"
    words = (
        *("agree", "shifted relative", "contradict", "count as missing", "interpolated", "jump"),
        *("refined", "declared as", "of the images is up"),
    )
    reported = ", reported" if any(word in log for word in words) else ""
    worse = ", worse than its images allow" if "worse than its images" in log else ""
    return f"{psnr}{ate}, {lost} lost or doubtful{reported}{worse}"


PAGE = Page(
    "inputs",
    "Recordings as people have them",
    DESCRIPTION,
    {name: name for name in KINDS},
    measure,
    lambda rows: [table_of(("right", "found"), rows, "input")],
)

if __name__ == "__main__":
    PAGE.main()
