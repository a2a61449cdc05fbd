"""semsplat and Open3D on the same frames.

    SEMSPLAT_DATA=DATA python -m benchmarks.accuracy.compare_open3d redkitchen
    python -m benchmarks.accuracy.compare_open3d room --max-frames 100 --out runs/bench

Each row runs in a process of its own: Open3D's dense SLAM (frame-to-model, with its own number of
iterations and with more), Open3D's frame-to-frame odometry (two methods), `semsplat run`, and the
same with AVX2 kernels. With `--seeds 3` each row is the median, since Open3D differs from run to
run on several threads.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.shared.programs import semsplat_command
from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.repository import ROOT
from benchmarks.shared.results_file import RESULTS
from benchmarks.shared.runner import Options, Page
from benchmarks.shared.tables import Metrics, Rows, Table, Target, median_of, table_of
from toolkit.runs.evaluation.metrics import flattened, read_metrics

# Title, key in the figures of Open3D, metric of semsplat, digits after the point.
COLUMNS = (
    ("ATE RMSE cm (SE(3))", "ate_rmse_cm", "trajectory.ate_rmse_cm", 2),
    ("rotation RPE deg", "rpe_rotation_deg", "trajectory.rpe_rotation_deg", 3),
    ("track ms", "track_ms", "time.tracking_ms_per_frame", 1),
    ("integrate or map ms", "integrate_ms", "time.mapping_ms_per_frame", 1),
    ("ray cast ms", "ray_cast_ms", "", 1),
    ("online ms", "", "time.online_ms_per_frame", 1),
    ("whole frame ms", "frame_ms", "time.total_ms_per_frame", 1),
    ("peak MB", "peak_memory_mb", "memory.peak_mb", 0),
)
TITLES = {
    "dense-slam": "Open3D dense SLAM (1 cm voxels, its 6/3/1 iterations)",
    "dense-slam-tuned": "Open3D dense SLAM (1 cm voxels, 30/20/10 iterations)",
    "odometry": "Open3D odometry (frame to frame, hybrid, 30/20/10 iterations)",
    "odometry-planes": "Open3D odometry (frame to frame, point-to-plane, 30/20/10 iterations)",
    "semsplat": "semsplat",
    "semsplat-avx2": "semsplat with AVX2 kernels",
}
# Largest times on a sequence, of Open3D's whole frame: online, and with the final refinement.
TARGETS = {
    "redkitchen": (1.0, 2.0),
    "redkitchen-native": (1.0, 1.8),
    "fr1_rpy": (3.0, 5.0),
    "office0": (2.0, 4.0),
}
NOTE = """\
Default settings of semsplat (`--image-size 320 240` on redkitchen and fr1_rpy, native size
elsewhere); Open3D with its normal threads, 1 cm voxels. Open3D's times are medians over frames;
those of semsplat are means, since mapping does not run on every frame. Its online time is the
wall-clock time of the loop over all frames, with labelling, loop closing, relocalisation and
waiting for images; its whole frame ("everything") adds the refinement at the end. Targets are
ratios to the whole frame of Open3D's dense SLAM with its own numbers of iterations."""
# Open3D ignores depth beyond this, which is its own default; its ray casting can hang.
_DEPTH_MAX_M, _TIMEOUT_S = 3.0, 1800.0


@dataclass(frozen=True, kw_only=True)
class CompareOptions(Options):
    """Compare on one sequence."""

    sequence: tyro.conf.Positional[str]
    """redkitchen, redkitchen-native, fr1_rpy, office0, room or room-noise."""
    max_frames: int | None = None
    """Number of frames from the start; all if unset."""


def measure(job: Mapping[str, Any], seed: int) -> Metrics:
    """The figures of one method."""
    method, limit = job["method"], job["max_frames"]
    options = sequence_arguments(job["sequence"])
    options += [] if limit is None else ["--max-frames", str(limit)]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        if method.startswith("semsplat"):
            command = semsplat_command("run", "--out", str(out), "--seed", str(seed), *options)
            run_child(command, {"SEMSPLAT_ISA": "avx2"} if method.endswith("avx2") else {})
            found = flattened(read_metrics(out / "metrics.json"))
            figures = {title: found.get(metric) for title, _, metric, _ in COLUMNS}
        else:
            command = [sys.executable, "-m", "benchmarks.shared.open3d_rivals", "--rival", method]
            command += ["--out", str(out), "--depth-max-m", str(_DEPTH_MAX_M), *options]
            run_child(command)
            found = json.loads(out.read_text())
            figures = {title: found.get(key) for title, key, *_ in COLUMNS}
    digits = {title: count for title, *_, count in COLUMNS}
    return {k: None if v is None else round(v, digits[k]) for k, v in figures.items()}


def run_child(
    command: list[str],
    variables: Mapping[str, str] | None = None,
    timeout_s: float = _TIMEOUT_S,
) -> None:
    """Run a child to its end.

    Args:
        variables: additional environment variables.

    Raises:
        SystemExit: it failed, or was stopped because it ran out of time.
    """
    python_path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, **(variables or {}), "PYTHONPATH": python_path}
    given: dict[str, Any] = {"env": environment, "timeout": timeout_s}
    try:
        done = subprocess.run(command, **given, capture_output=True, text=True, check=False)
    except subprocess.TimeoutExpired as error:
        raise SystemExit(f"stopped after {timeout_s:.0f} s") from error
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        raise SystemExit(f"exit code {done.returncode}: {last}")


def targets(rows: Rows, sequence: str) -> list[Target]:
    """What semsplat's time per frame should be, relative to Open3D's dense SLAM."""
    median, found = median_of(rows), []
    whole = median(TITLES["dense-slam"], "whole frame ms")
    for name, suffix in (("semsplat", ""), ("semsplat-avx2", ", AVX2")):
        keys = (("online", "online ms"), ("everything", "whole frame ms"))
        for (what, key), bar in zip(keys, TARGETS.get(sequence, ()), strict=False):
            value = median(TITLES[name], key)
            if value is not None and whole:
                found.append(Target(f"{what}{suffix}", value / whole, at_most=bar))
    return found


def table(rows: Rows) -> Table:
    """A row for each method; a figure that does not exist reads n/a."""
    return table_of([title for title, *_ in COLUMNS], rows, "method")


def main() -> None:
    """Compare on one sequence."""
    options = tyro.cli(CompareOptions)
    sequence, limit = options.sequence, options.max_frames
    if limit is not None and options.out.resolve() == RESULTS:
        raise SystemExit("--max-frames changes what is measured; give --out")
    jobs = {
        title: {"sequence": sequence, "method": method, "max_frames": limit}
        for method, title in TITLES.items()
    }
    page: Page[Mapping[str, Any]] = Page(
        f"open3d-{sequence}",
        f"Open3D and semsplat on {sequence}",
        NOTE,
        jobs,
        measure,
        lambda rows: [table(rows)],
        lambda rows: targets(rows, sequence),
    )
    page.write(options)


if __name__ == "__main__":
    main()
