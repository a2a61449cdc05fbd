"""What the checks at the start of a run say about recordings that are right, and about others.

    python -m benchmarks.inputs.checks

SEMSPLAT_DATA must hold the recordings; the trials are left out where it lacks them.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.shared.programs import semsplat_command
from benchmarks.shared.recordings import RECORDINGS, SHORT_ROOMS, source_of
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, Rows, Table, table_of
from toolkit.base.options import validated
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.carrier import without_carrier
from toolkit.datasets.depth_samples import with_usable_depth
from toolkit.datasets.registry import describe
from toolkit.datasets.samples import spread_frames
from toolkit.runs.folder import RunFolder
from toolkit.runs.image_side import find_side
from toolkit.runs.modes import mode_of
from toolkit.runs.settings import RunSettings

DESCRIPTION = """\
The checks that compare what is stated about a recording with its images, as `semsplat run` makes
them before the first frame: kind and unit of depth, registration, intrinsics, poses, labels, the
side that is up, and parts of the image that move with the camera. Their time includes reading the
frames, but not the estimate of the rolling shutter, which is part of a run. "First N" is a
recording of its first N frames. Properties of the data that are true are in parentheses."""
_NAMES = ("redkitchen-native", "redkitchen_30fps", "fr1_rpy", "office0", "hololens", "euroc")
_FIRST = (None, 50, 30)
# Trials, and what the checks, or a run where priors are given, should report.
TRIALS = {
    "ascii_output": "nothing",
    "corridor_blank": "nothing",
    "depth_unit_25": "depth times 0.8",
    "ego_body": "the lowest fifth of the image",
    "evaluate_other": "nothing",
    "fork": "nothing",
    "given_late": "poses 3 frames (0.2 s) late",
    "ids_permuted": "labels disagree",
    "moving_object": "nothing",
    "prior_inverse_as_metric": "the kind of the priors",
    "sideways": "the left side is up",
    "stripes_still": "nothing",
    "tiles": "nothing",
    "upside_down": "the bottom is up",
    "wrong_focal": "a focal length of 128",
}
# Errors of intrinsics: factor of the focal length, and distortion that is undone without need.
_ERRORS = {"f 5 % too long": (1.05, 0.0), "k1 -0.1": (1.0, 0.1), "k1 -0.25": (1.0, 0.25)}
_WRONG = ("redkitchen-native", "fr1_rpy", "office0", "hololens", "short-room-noise", "short-ring")


def _jobs() -> tuple[dict[str, dict[str, Any]], ...]:
    """Recordings that are right, with wrong intrinsics, and trials."""
    right: dict[str, dict[str, Any]] = {
        name if first is None else f"{name}, first {first}": {"name": name, "first": first}
        for name in (*_NAMES, "tartanair-corridor", *SHORT_ROOMS)
        for first in (_FIRST if name in RECORDINGS else (None,))
    }
    wrong: dict[str, dict[str, Any]] = {
        f"{name}, {error}": {"name": name, "error": error} for name in _WRONG for error in _ERRORS
    }
    trials = {name: {"trial": name} for name in TRIALS if (_trials() / name).is_dir()}
    return right, wrong, trials


def _trials() -> Path:
    return Path(os.environ.get("SEMSPLAT_DATA", "")) / "trials"


def tables(rows: Rows) -> list[Table]:
    """A table for each kind of job."""
    columns = ("said", "CPU s", "wall s")
    right, wrong, trials = ({n: rows[n] for n in jobs if n in rows} for jobs in _jobs())
    return [
        table_of(("frames", *columns), right, "recording"),
        table_of(columns, wrong, "recording", "Wrong intrinsics"),
        table_of(("right", *columns), trials, "trial", "Trials"),
    ]


def measure(job: Mapping[str, Any], _seed: int) -> Metrics:
    """What the checks say of a job, and their time in seconds."""
    if "trial" in job:
        folder, right = _trials() / job["trial"], {"right": TRIALS[job["trial"]]}
        if (folder / "priors").is_dir():
            return _run_outcome(folder) | right
        return checked(describe("folder", folder / "data")) | right
    kind, path, _ = source_of(job["name"])
    recording = describe(kind, path)
    if "error" in job:
        factor, k1 = _ERRORS[job["error"]]
        camera, (own, *others) = recording.camera, recording.distortion or (0.0,) * 5
        camera = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
        distortion = (own + k1, *others) if own or k1 else None
        recording = replace(recording, camera=camera, distortion=distortion)
    return checked(recording, job.get("first"))


def checked(recording: Recording, max_frames: int | None = None) -> Metrics:
    """The lines of all checks about a recording, and their time.

    Args:
        max_frames: maximum number of frames from the start, or None for all.
    """
    settings, flaws = validated(RunSettings, {}), recording.flaws
    recording = replace(recording, readout_s=recording.readout_s or 0.0, notes=())
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    recording = without_carrier(with_usable_depth(recording, max_frames), max_frames)
    dataset = RecordedDataset(recording, max_frames=max_frames)
    frames = [*spread_frames(dataset)]
    side = find_side(dataset, frames, settings.dataset)
    lines = mode_of(settings).findings(dataset, frames, settings)
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    true = [f"({line})" for line in (*recording.notes, *side.notes)]
    said = "; ".join([*flaws, *lines, *side.findings, *true]).replace("|", "/") or "nothing"
    return {"frames": len(dataset), "said": said, "CPU s": cpu_s, "wall s": wall_s}


def _run_outcome(folder: Path) -> Metrics:
    """The warnings of a trial's run; its time is not that of the checks."""
    (command,) = (folder / "CMD").read_text(encoding="utf-8").splitlines()
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary) / "trial"
        shutil.copytree(folder, work)
        words = shlex.split(command.split("&&")[0])[1:]
        subprocess.run(semsplat_command(*words), cwd=work, capture_output=True, check=True)
        log = RunFolder(work / words[words.index("--out") + 1]).log.read_text(encoding="utf-8")
    lines = [line for line in log.splitlines() if " WARNING " in line]
    said = "; ".join(line.split(": ", 1)[1] for line in lines) or "nothing"
    return {"said": f"by the run: {said}"}


PAGE = Page(
    "checks",
    "Checks at the start of a run",
    DESCRIPTION,
    {name: job for jobs in _jobs() for name, job in jobs.items()},
    measure,
    tables,
)

if __name__ == "__main__":
    PAGE.main()
