"""`semsplat run --pace`: delay of the poses, accuracy, and quality before and after refinement.

    SEMSPLAT_DATA=DATA python -m benchmarks.pace [--only NAMES]

Run it on an idle machine: the results depend on the time that the machine has for each frame.
"""

from __future__ import annotations

import csv
import shlex
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from benchmarks.programs import semsplat
from benchmarks.recordings import sequence_arguments
from benchmarks.report import Report, ReportOptions
from benchmarks.tables import MISSING, Metrics, Table, table_of
from toolkit.datasets.registry import open_dataset
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.metrics import flattened, read_metrics
from toolkit.runs.folder import RunFolder
from toolkit.runs.outcome import tracked_frames
from toolkit.runs.scoring import evaluate_scene
from toolkit.runs.settings import load_settings

COLUMNS = (
    "pace.fps",
    "trajectory.ate_rmse_cm",
    "psnr_before_refinement_db",
    "images.mapped.psnr_db",
    "images.unseen_refined.psnr_db",
    "pace.delay_median_ms",
    "pace.delay_p95_ms",
    "pace.delay_max_ms",
    "pace.delay_bound_ms",
    "frames.total",
    "pace.frames_dropped",
    "pace.frames_late",
    "frames.lost",
    "frames.keyframes",
    "pace.keyframes_thinned",
    "pace.mapping_steps_due",
    "pace.mapping_steps_deferred",
    "pace.mapping_steps_skipped",
    "time.refinement_ms_per_frame",
)
ROWS: dict[str, list[str]] = {
    "RedKitchen, offline": ["redkitchen"],
    "RedKitchen, 15 per second": ["redkitchen", "--pace", "15"],
    "room, offline": ["room"],
    "room, 30 per second": ["room", "--pace", "30"],
}
_PARTS = 10
DESCRIPTION = f"""\
`semsplat run` offline and with `--pace`, where frames arrive at camera rate and mapping uses the
time that remains. RedKitchen and the synthetic room have 320x240 pixels. The delay is the time from
the arrival of a frame to its pose. All frames are scored, dropped ones at the last pose before
them. PSNR is the mean over at most 100 views of the recording; before the final refinement, it is
that of the same run, fused without the optimisation steps of the refinement. Runs with `--pace`
depend on the speed of the machine and are not reproducible. The second table divides each sequence
into {_PARTS} parts of equal length: median and maximum of the delay in ms, and dropped frames."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Run sequences offline and at camera rate."""

    extra: str = ""
    """Further options of every run, in one string."""
    name: str = "pace"
    """Name of the results file; give another one with --extra."""


def main() -> None:
    """Measure one row for each sequence and pace."""
    options = tyro.cli(Options)
    extra = shlex.split(options.extra)
    if extra and options.name == Options.name:
        raise SystemExit("--extra changes what is measured; give the results a --name of their own")
    report = Report(options.name, "Real time", DESCRIPTION, options)
    rows = report.measured({name: [*row, *extra] for name, row in ROWS.items()}, measure)
    paced = {name: runs[0] for name, runs in rows.items() if "delays_ms" in runs[0]}
    figure = f"{options.name}.svg"
    if paced:
        draw(paced, options.out / figure)
    report.write(table_of(COLUMNS, rows, "sequence"), delay_table(paced, figure))


def measure(job: list[str], seed: int) -> Metrics:
    """Run one sequence; the delays are part of the metrics."""
    sequence, *options = job
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "run"
        arguments = [*sequence_arguments(sequence), *options, "--seed", str(seed)]
        semsplat("run", *arguments, "--out", str(out))
        metrics = flattened(read_metrics(out / "metrics.json"))
        folder = RunFolder.open(out)
        if folder.delays.exists():
            metrics |= _delays(folder.delays)
        metrics["psnr_before_refinement_db"] = _psnr_before_refinement(folder)
    return metrics


def _delays(path: Path) -> Metrics:
    """Arrivals in seconds and delays in milliseconds, None for dropped frames."""
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {
        "arrivals_s": [float(row["arrival_s"]) for row in rows],
        "delays_ms": [1e3 * float(row["delay_s"]) if row["delay_s"] else None for row in rows],
    }


def _psnr_before_refinement(folder: RunFolder) -> float | None:
    """PSNR of the map as it was after the last frame, which a checkpoint holds; overwrites it."""
    settings = load_settings(folder.config)
    assert settings.dataset.path is not None
    dataset = open_dataset(
        settings.dataset.kind, settings.dataset.path, settings.image_size, settings.max_frames
    )
    mapping = replace(settings.mapping, final_iterations=0)
    slam = build_slam(dataset, replace(settings, mapping=mapping), folder)
    checkpoint = folder.checkpoints.load()
    assert checkpoint is not None
    slam.restore(checkpoint.arrays, checkpoint.values)
    result = slam.finish()
    tracked = tracked_frames(result, settings)
    value = evaluate_scene(result.map, tracked, dataset, settings)["images"]["mapped"]["psnr_db"]
    return None if value is None else float(value)


def delay_table(runs: Mapping[str, Metrics], figure: str) -> Table:
    """Delay and dropped frames in each part of the sequences.

    Args:
        figure: name of the picture of the delays, in the folder of the results.
    """
    columns = tuple(f"{name}: {what}" for name in runs for what in ("median", "max", "dropped"))
    parts = {name: np.array_split(_values(run), _PARTS) for name, run in runs.items()}
    rows = [
        (str(part + 1), *(cell for name in runs for cell in _cells(parts[name][part])))
        for part in range(_PARTS)
    ]
    note = f"![Delay over time]({figure})" if runs else ""
    return Table(("part", *columns), tuple(rows), "Delay over time", note)


def _values(run: Metrics) -> np.ndarray:
    """Delays [N] in milliseconds, nan for dropped frames."""
    return np.array(run["delays_ms"], np.float64)


def _cells(delays_ms: np.ndarray) -> Sequence[str]:
    known = delays_ms[np.isfinite(delays_ms)]
    dropped = str(len(delays_ms) - len(known))
    if not len(known):
        return MISSING, MISSING, dropped
    return f"{np.median(known):.0f}", f"{known.max():.0f}", dropped


def draw(runs: Mapping[str, Metrics], path: Path) -> None:
    """Draw the delay of each frame over its time of arrival; dropped frames are marked."""
    figure = Figure(figsize=(8, 2.4 * len(runs)), layout="constrained")
    axes = figure.subplots(len(runs), squeeze=False)[:, 0]
    for panel, (name, run) in zip(axes, runs.items(), strict=True):
        arrivals_s, delays_ms = np.array(run["arrivals_s"]), _values(run)
        dropped = np.isnan(delays_ms)
        panel.plot(arrivals_s, delays_ms, linewidth=1, marker=".", markersize=2)
        panel.plot(arrivals_s[dropped], np.zeros(dropped.sum()), "|r", label="dropped frames")
        panel.axhline(run["pace.delay_bound_ms"], color="black", linestyle="--", linewidth=1)
        panel.set(title=name, xlabel="time of arrival, s", ylabel="delay, ms", ylim=(0, None))
        if dropped.any():
            panel.legend(loc="upper right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


if __name__ == "__main__":
    main()
