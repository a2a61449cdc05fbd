"""Accuracy, image quality and time of every preset.

    SEMSPLAT_DATA=DATA python -m benchmarks.presets [--frames 60]

Writes a table and a plot of ATE and PSNR over the time per frame (presets.svg beside the table).
The presets of the papers take many seconds per frame; all presets process the same frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

import matplotlib
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.recordings import RECORDINGS, room
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_slam
from benchmarks.tables import Metrics, Rows, median_of, table_of
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import open_dataset
from toolkit.runs.settings import PresetName, RunSettings, load_settings

# The monocular system needs weights.
PRESETS: tuple[PresetName, ...] = tuple(
    name for name in get_args(PresetName) if name != "hier-slam-mono"
)
SEQUENCES = {"RedKitchen": "redkitchen", "fr1_rpy": "fr1_rpy", "room": "room"}

ONLINE, TOTAL = "time.online_ms_per_frame", "time.total_ms_per_frame"
COLUMNS = (
    "trajectory.ate_rmse_cm",
    "images.mapped.psnr_db",
    "images.mapped.ssim",
    "depth.mapped.l1_cm",
    "semantics.mapped.miou_percent",
    "frames.lost",
    "map.gaussians",
    ONLINE,
    TOTAL,
    "frames.total",
)
PLOT = "presets.svg"
DESCRIPTION = f"""\
The presets of `semsplat run` on the first frames of three sequences, all at 320x240: 7-Scenes
RedKitchen, TUM fr1/rpy and the synthetic room (`semsplat make-room`). Labels are those of planes on
RedKitchen and fr1/rpy and those of the dataset in the room. ATE after SE(3) alignment; PSNR is the
mean over views of the dB over all pixels, of at most 100 evenly spaced views. `{ONLINE}` is the
wall-clock time of processing a frame, loop closure and relocalisation included; `{TOTAL}` also
contains the final refinement, spread over the frames. Reading the images and the evaluation are not
included.

![ATE and PSNR of the presets over the time per frame]({PLOT})"""

# Colours that remain distinct for colour-blind readers (Okabe and Ito).
_COLOURS = ("#E69F00", "#000000", "#009E73", "#56B4E9", "#CC79A7")
_MARKERS = ("v", "o", "^", "s", "D")


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure every preset on every sequence."""

    frames: int = 60
    """Number of frames of each sequence."""
    seeds: int = 1
    """Seeds 0, 1, ... of each row."""


@dataclass(frozen=True)
class Row:
    """One preset on one sequence."""

    sequence: str
    preset: PresetName


ROWS = {
    f"{title}, {preset}": Row(sequence, preset)
    for title, sequence in SEQUENCES.items()
    for preset in PRESETS
}


def main() -> None:
    """Measure one row for each preset and sequence."""
    options = tyro.cli(Options)
    report = Report("presets", "Presets", DESCRIPTION, options, range(options.seeds))
    jobs = {name: asdict(row) | {"frames": options.frames} for name, row in ROWS.items()}
    rows = report.measured(jobs, measure)
    if set(rows) == set(ROWS):
        options.out.mkdir(parents=True, exist_ok=True)
        plot(rows, options.out / PLOT)
    report.write(table_of(COLUMNS, rows, "sequence, preset"))


def measure(job: dict[str, Any], seed: int) -> Metrics:
    """Metrics of one preset on one sequence."""
    settings = settings_of(job["sequence"], job["preset"], job["frames"], seed)
    path = settings.dataset.path
    assert path is not None
    dataset = open_dataset(settings.dataset.kind, path, settings.image_size, settings.max_frames)
    with finished_slam(settings, dataset) as run:
        return run.metrics


def settings_of(sequence: str, preset: str, frames: int, seed: int) -> RunSettings:
    """The settings of a preset for the first frames of a recording or a synthetic sequence."""
    if sequence in RECORDINGS:
        recording = RECORDINGS[sequence]
        dataset = DatasetOptions(recording.kind, recording.path)  # type: ignore[arg-type]
        size = recording.image_size
    else:
        dataset, size = DatasetOptions("synthetic", room(sequence)), None
    preset_settings = load_settings(preset=preset)
    return replace(preset_settings, dataset=dataset, image_size=size, max_frames=frames, seed=seed)


def plot(rows: Rows, path: Path) -> None:
    """Draw ATE and PSNR of each sequence over the total time per frame."""
    figure = Figure(figsize=(9.5, 5.2), layout="constrained")
    axes = figure.subplots(2, len(SEQUENCES), sharex="col", squeeze=False)
    metrics = {"trajectory.ate_rmse_cm": "ATE RMSE in cm", "images.mapped.psnr_db": "PSNR in dB"}
    for column, title in enumerate(SEQUENCES):
        for line, (metric, label) in enumerate(metrics.items()):
            values = _points(rows, title, metric)
            _draw(axes[line, column], values)
            if column == 0:
                axes[line, 0].set_ylabel(label)
        axes[0, column].set_title(title)
        axes[0, column].set_yscale("log")
        axes[1, column].set_xlabel("seconds per frame")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(PRESETS), frameon=False)
    # Equal results give equal files; text stays text.
    with matplotlib.rc_context({"svg.hashsalt": "presets", "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None})


def _points(rows: Rows, title: str, metric: str) -> dict[str, tuple[float, float]]:
    """Time in seconds per frame and the metric of each preset that has both."""
    median = median_of(rows)
    found: dict[str, tuple[float, float]] = {}
    for preset in PRESETS:
        time_ms = median(f"{title}, {preset}", TOTAL)
        value = median(f"{title}, {preset}", metric)
        if time_ms is not None and value is not None:
            found[preset] = (1e-3 * time_ms, value)
    return found


def _draw(axes: Axes, points: Mapping[str, Sequence[float]]) -> None:
    for preset, colour, marker in zip(PRESETS, _COLOURS, _MARKERS, strict=True):
        if preset in points:
            time_s, value = points[preset]
            axes.plot(time_s, value, marker, color=colour, label=preset, markersize=7)
    axes.set_xscale("log")
    axes.grid(visible=True, which="major", alpha=0.3)


if __name__ == "__main__":
    main()
