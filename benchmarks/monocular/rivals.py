"""Motion from images alone: semsplat beside ORB-SLAM3 and COLMAP, on the same images.

pip install --no-deps orbslam3-python; pip install pycolmap
SEMSPLAT_DATA=DATA python -m benchmarks.monocular.rivals [--only NAMES]

orbslam3-python demands opencv-python, which must not be installed beside the headless one.
"""

from __future__ import annotations

import importlib.util
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.monocular.methods import EveryNth, Grey, MethodName, grey
from benchmarks.monocular.motion_errors import motion_errors
from benchmarks.monocular.orb_vocabulary import write_vocabulary
from benchmarks.shared.recordings import INVERTED_ROTATIONS, opened
from benchmarks.shared.runner import WORK, Page
from benchmarks.shared.tables import Metrics, table_of
from toolkit.base.geometry.trajectory import Trajectory

COLUMNS = (
    *("outcome", "frames", "located", "compared", "ate_rmse_cm", "still_cm", "rotation_rms_deg"),
    *("cpu_s", "peak_memory_mb"),
)
LABELS: dict[MethodName, str] = {
    "semsplat": "semsplat",
    "orbslam3": "ORB-SLAM3",
    "colmap": "COLMAP",
}
_PACKAGES = {"orbslam3": "orbslam3", "colmap": "pycolmap"}
# The sequence of each name, and the interval of the frames that COLMAP is given.
SEQUENCES = {
    "office0": ("office0", 1),
    "EuRoC V1_01": ("euroc", 2),
    "room": ("room", 6),
    "room, sensor noise": ("room-noise", 6),
    "RedKitchen": ("redkitchen", 4),
    "HoloLens walk": ("hololens", 4),
    "HoloLens walk, 270x180": ("hololens-small", 4),
    "walk through rooms": ("walk", 10),
    "fast walk through rooms": ("walk-fast", 5),
    "film of objects": ("phone", 12),
    "fr1/rpy": ("fr1_rpy", 2),
}
# ORB-SLAM3's threads race each other.
_RUNS = {"orbslam3": 3}
_LIMIT_S = 300
_VOCABULARY_IMAGES = 40
DESCRIPTION = f"""\
Poses from the same grey images and intrinsics, on one thread (ORB-SLAM3 has three). Images are as
in monocular.md. semsplat is `estimate_motion`, the motion on which `--depth none` builds its map.

ORB-SLAM3 is the package orbslam3-python, without IMU; it comes without a vocabulary, so that one
has been trained from {_VOCABULARY_IMAGES} images of each of these sequences, and images are given
to it slowly enough for its mapping thread. Its results vary: a row is the median of
{_RUNS["orbslam3"]} runs by their error. COLMAP is pycolmap's incremental mapping with exhaustive
matching; where that would take long, it has every second, fourth or sixth frame, and semsplat is
measured on those too.

`located`: frames with a pose in one map. `compared`: those whose pose is known in the end, which
for ORB-SLAM3 are frames whose keyframe has not been removed since. Errors are those of the compared
frames after Sim(3) alignment, which favours methods that locate few. `still_cm`: the error of a
camera that never moves, on the same frames. Rotation: RMS after alignment of the orientations; none
for EuRoC, whose file of true poses has inverted rotations. `cpu_s`: processor time of all threads;
a method is stopped after {_LIMIT_S} s."""


def _jobs() -> dict[str, list[str | int]]:
    jobs: dict[str, list[str | int]] = {}
    for name, (sequence, every) in SEQUENCES.items():
        for method, label in LABELS.items():
            step = every if method == "colmap" else 1
            jobs[_row(name, label, step)] = [method, sequence, step]
        jobs[_row(name, LABELS["semsplat"], every)] = ["semsplat", sequence, every]
    return jobs


def _row(name: str, label: str, every: int) -> str:
    return f"{name}: {label}" + (f", every {every} frames" if every > 1 else "")


def measure(job: list[str | int], _seed: int) -> Metrics:
    """Run one method; the median run by its error if it is not reproducible."""
    method, sequence, every = str(job[0]), str(job[1]), int(job[2])
    package = _PACKAGES.get(method)
    if package is not None and importlib.util.find_spec(package) is None:
        return {"outcome": "not installed"}
    runs = [_measured(method, sequence, every) for _ in range(_RUNS.get(method, 1))]
    runs.sort(key=lambda run: run.get("ate_rmse_cm", math.inf))
    return runs[len(runs) // 2]


def _measured(method: str, sequence: str, every: int) -> Metrics:
    """Run one method in a process of its own."""
    dataset = opened(sequence)
    metrics: Metrics = {"frames": len(EveryNth(dataset, every))}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "motion.npz"
        arguments = ["--method", method, "--sequence", sequence, "--every", str(every)]
        if method == "orbslam3":
            arguments += ["--vocabulary", str(vocabulary())]
        metrics["outcome"] = _outcome([*arguments, "--out", str(out)])
        if not out.exists():
            return metrics
        with np.load(out) as found:
            motion = Trajectory(found["timestamps_s"], found["T_world_camera"])
            metrics |= {"located": int(found["located"]), "compared": len(motion)}
            metrics |= {name: float(found[name]) for name in ("cpu_s", "peak_memory_mb")}
    assert dataset.ground_truth is not None
    errors = motion_errors(motion, dataset.ground_truth)
    if sequence in INVERTED_ROTATIONS:
        errors.pop("rotation_rms_deg", None)
    return metrics | errors


def _outcome(arguments: list[str]) -> str:
    """Run a method; how it ended."""
    command = [sys.executable, "-m", "benchmarks.monocular.methods", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, capture_output=True, check=False, timeout=_LIMIT_S, env=environment
        )
    except subprocess.TimeoutExpired:
        return f"stopped after {_LIMIT_S} s"
    if done.returncode < 0:
        return f"crashed with signal {-done.returncode}"
    if done.returncode:
        lines = done.stderr.decode(errors="replace").split("\n")
        return "failed: " + next((line for line in reversed(lines) if line.strip()), "")[:100]
    return "finished"


def vocabulary() -> Path:
    """The words of ORB-SLAM3, which are trained when they are first needed."""
    path = WORK / "orb_vocabulary.txt"
    if not path.exists():
        print("training a vocabulary", flush=True)
        write_vocabulary(path, _training_images())
    return path


def _training_images() -> Iterator[Grey]:
    for sequence, _ in SEQUENCES.values():
        dataset = opened(sequence)
        chosen = np.linspace(0, len(dataset) - 1, _VOCABULARY_IMAGES).astype(int)
        for index in np.unique(chosen):
            yield grey(dataset[int(index)])


PAGE = Page(
    "monocular_rivals",
    "Motion from images",
    DESCRIPTION,
    _jobs(),
    measure,
    lambda rows: [table_of(COLUMNS, rows, "sequence")],
)

if __name__ == "__main__":
    PAGE.main()
