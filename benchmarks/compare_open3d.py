"""Ours beside Open3D on the same frames: one Markdown table.

    python -m benchmarks.compare_open3d --dataset.kind seven-scenes --dataset.path DIR \\
        --image-size 320 240

Each row runs in a process of its own: Open3D's dense SLAM (frame-to-model, with its
iterations and with more), Open3D's frame-to-frame odometry (two methods), and `semsplat run`. With
`--repeats 3` each row is the median, since Open3D differs from run to run on several
threads; ours then runs with the seeds 0, 1, 2.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal, get_args

import tyro

from benchmarks.machine import describe_machine

RowName = Literal["dense-slam", "dense-slam-tuned", "odometry", "odometry-planes", "semsplat"]
Figures = dict[str, float | None]

_ROOT = Path(__file__).resolve().parent.parent
_log = logging.getLogger("compare_open3d")

# Column title, key in a row's figures, digits after the point.
COLUMNS = (
    ("ATE RMSE cm (SE(3))", "ate_rmse_cm", 2),
    ("rotation RPE deg", "rpe_rotation_deg", 3),
    ("track ms", "track_ms", 1),
    ("integrate or map ms", "integrate_ms", 1),
    ("ray cast ms", "ray_cast_ms", 1),
    ("whole frame ms", "frame_ms", 1),
    ("peak MB", "peak_memory_mb", 0),
)
TITLES = {
    "dense-slam": "Open3D dense SLAM (1 cm voxels, its 6/3/1 iterations)",
    "dense-slam-tuned": "Open3D dense SLAM (1 cm voxels, 30/20/10 iterations)",
    "odometry": "Open3D odometry (frame to frame, hybrid, 30/20/10 iterations)",
    "odometry-planes": "Open3D odometry (frame to frame, point-to-plane, 30/20/10 iterations)",
    "semsplat": "semsplat",
}


TIMES_NOTE = (
    "Times: Open3D's are medians over frames; ours are means, since mapping does not run on "
    "every frame, and the whole frame includes the refinement at the end."
)


class RowError(Exception):
    """A row's process failed or ran out of time; the message is one line."""


@dataclass(frozen=True)
class DatasetArguments:
    """Which frames: as `semsplat run` takes them."""

    kind: str
    path: Path


@dataclass(frozen=True)
class Arguments:
    """Compare on one data set.

    Attributes:
        dataset: kind and folder.
        image_size: width and height in pixels; native where left out.
        max_frames: frames from the start; all where left out.
        rows: which methods to run.
        repeats: runs of each, of which the median is shown.
        depth_max_m: Open3D ignores depth beyond this (its own default is 3 m).
        timeout_s: a run that takes longer is stopped: Open3D's ray casting can hang.
        keep: folder for our run folders; a temporary one where left out.
        ours: further options for `semsplat run`, as one string.
    """

    dataset: DatasetArguments
    image_size: tuple[int, int] | None = None
    max_frames: int | None = None
    rows: tuple[RowName, ...] = get_args(RowName)
    repeats: int = 1
    depth_max_m: float = 3.0
    timeout_s: float = 1800.0
    keep: Path | None = None
    ours: str = ""


def rival_figures(name: str, arguments: Arguments, folder: Path, repeat: int) -> Figures:
    """Run one of Open3D's methods in a child process."""
    out = folder / f"{name}-{repeat}.json"
    command = [sys.executable, "-m", "benchmarks.open3d_rivals"]
    command += ["--rival", name, "--out", str(out)]
    command += ["--depth-max-m", str(arguments.depth_max_m), *_frame_options(arguments)]
    _run(command, arguments.timeout_s)
    return json.loads(out.read_text())


def our_figures(name: str, arguments: Arguments, folder: Path, repeat: int) -> Figures:
    """Run `semsplat run` in a child process and read its metrics.json."""
    out = folder / f"{name}-{repeat}"
    command = [sys.executable, "-m", "toolkit.cli.main", "run", "--out", str(out)]
    command += ["--seed", str(repeat), *_frame_options(arguments), *arguments.ours.split()]
    _run(command, arguments.timeout_s)
    metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    track_ms = metrics.get("tracking_ms_per_frame")
    map_ms = metrics.get("mapping_ms_per_frame")
    refine_ms = metrics.get("refinement_ms_per_frame") or 0.0
    return {
        "ate_rmse_cm": metrics.get("ate_rmse_cm"),
        "rpe_rotation_deg": metrics.get("rpe_rotation_deg"),
        "track_ms": track_ms,
        "integrate_ms": map_ms,
        "ray_cast_ms": None,
        "frame_ms": None if track_ms is None or map_ms is None else track_ms + map_ms + refine_ms,
        "peak_memory_mb": metrics.get("peak_memory_mb"),
    }


def markdown_table(rows: dict[str, Figures]) -> str:
    """A Markdown table of rows by title; a figure that does not exist reads n/a."""
    lines = [
        "| method | " + " | ".join(title for title, _, _ in COLUMNS) + " |",
        "|---|" + "---:|" * len(COLUMNS),
    ]
    for title, figures in rows.items():
        cells = [_cell(figures.get(key), digits) for _, key, digits in COLUMNS]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def median_figures(runs: list[Figures]) -> Figures:
    """The median of each figure over runs, None where no run has it."""
    keys = [key for _, key, _ in COLUMNS]
    values = {key: [run[key] for run in runs if run.get(key) is not None] for key in keys}
    return {key: median(found) if found else None for key, found in values.items()}  # type: ignore[type-var]


def _frame_options(arguments: Arguments) -> list[str]:
    options = ["--dataset.kind", arguments.dataset.kind]
    options += ["--dataset.path", str(arguments.dataset.path)]
    if arguments.image_size is not None:
        options += ["--image-size", *map(str, arguments.image_size)]
    if arguments.max_frames is not None:
        options += ["--max-frames", str(arguments.max_frames)]
    return options


def _run(command: list[str], timeout_s: float) -> None:
    """Run a child to its end.

    Raises:
        RowError: it failed, or was stopped because it ran out of time.
    """
    python_path = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": python_path}
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
    return "n/a" if value is None else f"{value:.{digits}f}"


def main(arguments: Arguments) -> int:
    """Run every row and print the table; 1 where a row failed."""
    rows: dict[str, Figures] = {}
    failed = False
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in arguments.rows:
            figures: Callable[..., Figures] = our_figures if name == "semsplat" else rival_figures
            try:
                runs = [figures(name, arguments, folder, i) for i in range(arguments.repeats)]
                rows[TITLES[name]] = median_figures(runs)
            except RowError as error:
                failed = True
                _log.error("%s: %s", name, error)
                rows[f"{TITLES[name]}: failed"] = {}
    print(f"{arguments.dataset.path.name}, median of {arguments.repeats}; {describe_machine()}\n")
    print(markdown_table(rows))
    print(f"\n{TIMES_NOTE}")
    return int(failed)


if __name__ == "__main__":
    logging.basicConfig(format="%(levelname)s %(message)s")
    sys.exit(main(tyro.cli(Arguments)))
