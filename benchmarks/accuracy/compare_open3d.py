"""semsplat and Open3D on the same frames.

    SEMSPLAT_DATA=DATA python -m benchmarks.accuracy.compare_open3d redkitchen
    python -m benchmarks.accuracy.compare_open3d room --max-frames 100

Results of all frames and rows have a file, others are printed. Each row runs in a process of its
own: Open3D's dense SLAM (frame-to-model, with its own number of iterations and with more),
Open3D's frame-to-frame odometry (two methods), `semsplat run`, and the same with AVX2 kernels. With
`--repeats 3` each row is the median, since Open3D differs from run to run on several threads;
semsplat then runs with the seeds 0, 1, 2.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal, get_args

import tyro

from benchmarks.shared.programs import semsplat_command
from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.repository import ROOT
from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.runner import publish
from benchmarks.shared.tables import MISSING, Table, Target, target_table
from toolkit.runs.evaluation.metrics import flattened, read_metrics

RowName = Literal[
    "dense-slam", "dense-slam-tuned", "odometry", "odometry-planes", "semsplat", "semsplat-avx2"
]
Figures = dict[str, float | None]

# Column title, key in a row's figures, metric of semsplat, digits after the point.
COLUMNS = (
    ("ATE RMSE cm (SE(3))", "ate_rmse_cm", "trajectory.ate_rmse_cm", 2),
    ("rotation RPE deg", "rpe_rotation_deg", "trajectory.rpe_rotation_deg", 3),
    ("track ms", "track_ms", "time.tracking_ms_per_frame", 1),
    ("integrate or map ms", "integrate_ms", "time.mapping_ms_per_frame", 1),
    ("ray cast ms", "ray_cast_ms", "", 1),
    ("online ms", "online_ms", "time.online_ms_per_frame", 1),
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


class RowError(Exception):
    """A row's process failed or ran out of time; the message is one line."""


@dataclass(frozen=True)
class Arguments:
    """Compare on one sequence.

    Attributes:
        sequence: redkitchen, redkitchen-native, fr1_rpy, office0, room or room-noise.
        max_frames: number of frames from the start; all if unset.
        rows: which methods to run.
        repeats: runs of each, of which the median is shown.
        depth_max_m: Open3D ignores depth beyond this (its own default is 3 m).
        timeout_s: a longer run is stopped, since Open3D's ray casting can hang.
        ours: further options for `semsplat run`, as one string.
        out: folder of the results file.
    """

    sequence: tyro.conf.Positional[str]
    max_frames: int | None = None
    rows: tuple[RowName, ...] = get_args(RowName)
    repeats: int = 1
    depth_max_m: float = 3.0
    timeout_s: float = 1800.0
    ours: str = ""
    out: Path = RESULTS


def rival_figures(name: str, arguments: Arguments, folder: Path, repeat: int) -> Figures:
    """Run one of Open3D's methods in a child process."""
    out = folder / f"{name}-{repeat}.json"
    command = [sys.executable, "-m", "benchmarks.shared.open3d_rivals", "--rival", name]
    command += ["--out", str(out), "--depth-max-m", str(arguments.depth_max_m)]
    _run([*command, *_frame_options(arguments)], arguments.timeout_s)
    return json.loads(out.read_text())


def our_figures(name: str, arguments: Arguments, folder: Path, repeat: int) -> Figures:
    """Run `semsplat run` in a child process and read its metrics.json."""
    out = folder / f"{name}-{repeat}"
    command = semsplat_command("run", "--out", str(out), "--seed", str(repeat))
    command += [*_frame_options(arguments), *arguments.ours.split()]
    _run(command, arguments.timeout_s, {"SEMSPLAT_ISA": "avx2"} if name.endswith("avx2") else {})
    metrics = flattened(read_metrics(out / "metrics.json"))
    return {key: metrics.get(metric) for _, key, metric, _ in COLUMNS}


def comparison_table(rows: Mapping[str, Figures]) -> Table:
    """A row for each method; a metric that does not exist reads n/a."""
    cells = [
        (title, *(_cell(figures.get(key), digits) for _, key, _, digits in COLUMNS))
        for title, figures in rows.items()
    ]
    return Table(("method", *(title for title, *_ in COLUMNS)), tuple(cells))


def targets(rows: Mapping[str, Figures], sequence: str) -> list[Target]:
    """What semsplat's time per frame should be, relative to Open3D's dense SLAM."""
    whole = rows.get(TITLES["dense-slam"], {}).get("frame_ms")
    found = []
    for name, suffix in (("semsplat", ""), ("semsplat-avx2", ", AVX2")):
        figures = rows.get(TITLES[name], {})
        keys = (("online", "online_ms"), ("everything", "frame_ms"))
        for (what, key), bar in zip(keys, TARGETS.get(sequence, ()), strict=False):
            value = figures.get(key)
            if value is not None and whole:
                found.append(Target(f"{what}{suffix}", value / whole, at_most=bar))
    return found


def median_figures(runs: list[Figures]) -> Figures:
    """The median of each figure over runs, None where no run has it."""
    medians: Figures = {}
    for _, key, *_ in COLUMNS:
        found = [value for run in runs if (value := run.get(key)) is not None]
        medians[key] = median(found) if found else None
    return medians


def _frame_options(arguments: Arguments) -> list[str]:
    few = arguments.max_frames
    limit = [] if few is None else ["--max-frames", str(few)]
    return [*sequence_arguments(arguments.sequence), *limit]


def _run(command: list[str], timeout_s: float, variables: Mapping[str, str] | None = None) -> None:
    """Run a child to its end.

    Args:
        variables: additional environment variables.

    Raises:
        RowError: it failed, or was stopped because it ran out of time.
    """
    python_path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, **(variables or {}), "PYTHONPATH": python_path}
    try:
        done = subprocess.run(
            command, env=environment, timeout=timeout_s, capture_output=True, text=True
        )
    except subprocess.TimeoutExpired as error:
        raise RowError(f"stopped after {timeout_s:.0f} s") from error
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        raise RowError(f"exit code {done.returncode}: {last}")


def _cell(value: float | None, digits: int) -> str:
    return MISSING if value is None else f"{value:.{digits}f}"


def main(arguments: Arguments) -> int:
    """Run every row; 1 where a row failed."""
    header = current_header(range(arguments.repeats))
    rows: dict[str, Figures] = {}
    with tempfile.TemporaryDirectory() as temporary:
        for name in arguments.rows:
            figures: Callable[..., Figures] = (
                our_figures if name.startswith("semsplat") else rival_figures
            )
            repeats = range(arguments.repeats)
            try:
                runs = [figures(name, arguments, Path(temporary), i) for i in repeats]
                rows[TITLES[name]] = median_figures(runs)
            except RowError as error:
                print(f"{name}: {error}", file=sys.stderr)
                rows[f"{TITLES[name]}: failed"] = {}
    judged = targets(rows, arguments.sequence)
    tables = (comparison_table(rows), *([target_table(judged)] if judged else []))
    title = f"Open3D and semsplat on {arguments.sequence}"
    results = Results(f"open3d-{arguments.sequence}", title, NOTE, header, tables)
    failed = any(title.endswith("failed") for title in rows)
    everything = arguments.rows == get_args(RowName) and arguments.max_frames is None
    if everything and not failed:
        publish(results, arguments.out)
    else:
        print(results.markdown())
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
