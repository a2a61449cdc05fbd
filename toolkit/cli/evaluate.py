"""`semsplat evaluate`: measure a run folder again."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from toolkit.cli.arguments import parse_arguments
from toolkit.errors import FormatError, SettingsError
from toolkit.evaluation.metrics import Metrics, read_metrics, write_metrics
from toolkit.gaussians.scene import WholeScene
from toolkit.runs.finished import FinishedRun, measured, open_finished_run, reading_of

_log = logging.getLogger(__name__)

_SHOWN = (
    "ate_rmse_cm",
    "rpe_rotation_deg",
    "psnr_db",
    "psnr_unseen_db",
    "psnr_unseen_refined_db",
    "ssim",
    "ms_ssim",
    "depth_l1_cm",
    "frames",
    "frames_lost",
    "gaussians",
)


@dataclass(frozen=True)
class DatasetPlace:
    """The run's data set."""

    path: Path | None = None
    """Its folder, if it has moved since the run."""


@dataclass(frozen=True)
class EvaluateOptions:
    """Measure a finished run again and rewrite its metrics.json; times and memory stay."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    dataset: DatasetPlace = DatasetPlace()
    max_views: int = 100
    """Most views scored of each group (mapped, held out, unseen), evenly spaced."""


def main(argv: Sequence[str]) -> int:
    """Evaluate a run.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run, its data set cannot be read, or a value is
            out of range.
    """
    options = parse_arguments(EvaluateOptions, argv, "evaluate")
    if options.max_views < 1:
        raise SettingsError(f"--max-views must be at least 1, got {options.max_views}")
    run = open_finished_run(options.run)
    path = options.dataset.path or run.dataset_path
    dataset = run.open_dataset(path)
    reading = reading_of(run.semantics, run.taxonomy, dataset)
    place = run.settings.dataset.model_copy(update={"path": path})
    settings = run.settings.model_copy(update={"dataset": place})
    scene = WholeScene(run.gaussians)
    figures = measured(scene, run.tracked, dataset, settings, reading, options.max_views)
    metrics = _earlier_metrics(run) | figures | _counts(run)
    write_metrics(run.folder.metrics, metrics)
    for key in _SHOWN:
        print(f"{key:<24}{_shown(metrics[key])}")
    print(f"wrote {run.folder.metrics}")
    return 0


def _counts(run: FinishedRun) -> Metrics:
    return {
        "frames": len(run.tracked) + len(run.lost),
        "frames_lost": len(run.lost),
        "keyframes": len(run.keyframes),
        "gaussians": len(run.gaussians),
    }


def _earlier_metrics(run: FinishedRun) -> Metrics:
    """What metrics.json holds: times and memory cannot be measured again."""
    if not run.folder.metrics.exists():
        return {}
    try:
        return read_metrics(run.folder.metrics)
    except FormatError as error:
        _log.warning("earlier figures are lost: %s", error)
        return {}


def _shown(value: float | int | str | None) -> str:
    if value is None:
        return "n/a"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
