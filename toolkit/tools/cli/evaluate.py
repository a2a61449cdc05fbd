"""`semsplat evaluate`: evaluate a finished run again."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from toolkit.base.errors import FormatError
from toolkit.runs.evaluation.expected_quality import shortfall_warnings
from toolkit.runs.evaluation.frame_states import part_lines
from toolkit.runs.evaluation.metrics import (
    Metrics,
    ate_frames,
    ate_warnings,
    flattened,
    read_metrics,
    truth_lines,
    write_metrics,
)
from toolkit.runs.evaluation.options import EvaluationOptions
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.runs.scoring import evaluate
from toolkit.tools.cli.programs import EvaluateOptions

_log = logging.getLogger(__name__)

_PRINTED = (
    "trajectory.ate_rmse_cm",
    "trajectory.rpe_rotation_deg",
    "loops.edges.count",
    "loops.edges.right",
    "loops.edges.error_max_cm",
    "loops.edges.error_max_deg",
    "loops.verified.overlap.precision_percent",
    "loops.verified.overlap.recall_percent",
    "images.mapped.psnr_db",
    "images.unseen.psnr_db",
    "images.unseen_refined.psnr_db",
    "images.mapped.ssim",
    "images.mapped.ms_ssim",
    "images.mapped.lpips",
    "depth.mapped.l1_cm",
    "frames.total",
    "frames.lost",
    "frames.doubtful",
    "frames.in_other_parts",
    "map.gaussians",
)
_PRINTED_MESH = (
    "mesh.accuracy_cm",
    "mesh.completion_cm",
    "mesh.completion_ratio_percent",
    "mesh.f_score_1cm_percent",
    "mesh.f_score_2cm_percent",
    "mesh.f_score_5cm_percent",
    "mesh.normal_consistency",
)
_PRINTED_SUBSET = (
    "semantics.mapped.miou_percent",
    "semantics.mapped.miou_subset_percent",
    "semantics.unseen.miou_subset_percent",
)


def main(options: EvaluateOptions) -> int:
    """Evaluate a run.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run, or its dataset or the weights of LPIPS cannot be
            read.
    """
    run = load_run(options.run)
    evaluation = _evaluation_settings(run, options)
    new_metrics = evaluate(run, options.dataset.path, options.max_views, evaluation, options.mesh)
    metrics = _earlier_metrics(run) | new_metrics
    write_metrics(run.folder.metrics, metrics)
    values = flattened(metrics)
    with_mesh = "mesh" in new_metrics
    for key in _PRINTED + _PRINTED_MESH * with_mesh + _PRINTED_SUBSET * evaluation.subset:
        print(f"{key:<42}{_format(values.get(key))}{_share(key, values)}")
    judged = (
        *ate_warnings(metrics),
        *truth_lines(new_metrics["trajectory"]),
        *shortfall_warnings(metrics, baseline=run.settings.tracking.kind != "dense"),
    )
    for line in (*judged, *part_lines(run.states, run.parts)):
        print(line)
    for key, value in values.items():
        if key.startswith("parts.part_"):
            print(f"{key:<42}{_format(value)}")
    print(f"wrote {run.folder.metrics}")
    return 0


def _evaluation_settings(run: FinishedRun, options: EvaluateOptions) -> EvaluationOptions:
    """Return the run's evaluation settings with the changes from the command line."""
    weights = options.lpips_weights or run.settings.evaluation.lpips_weights
    missing = [str(file) for file in weights if not file.is_file()]
    if missing and not options.lpips_weights:
        _log.warning("LPIPS is not computed: %s no longer exists.", missing[0])
        weights = ()
    evaluation = run.settings.evaluation
    subset = options.subset or evaluation.subset
    changed = {
        name: value
        for name in ("truth_error_m", "truth_error_deg", "truth_error_s")
        if (value := getattr(options, name)) is not None
    }
    truth = replace(evaluation.truth, **changed)
    return replace(evaluation, lpips_weights=weights, subset=subset, truth=truth)


def _earlier_metrics(run: FinishedRun) -> Metrics:
    """Return the content of metrics.json: times and memory cannot be measured again."""
    if not run.folder.metrics.exists():
        return {}
    try:
        return read_metrics(run.folder.metrics)
    except FormatError as error:
        _log.warning("Earlier metrics are not kept: %s.", error)
        return {}


def _share(key: str, values: Mapping[str, Any]) -> str:
    """Of how many frames the trajectory error is, if not of all."""
    frames = ate_frames(values) if key == "trajectory.ate_rmse_cm" else ""
    return f" {frames}" if frames else ""


def _format(value: float | int | str | None) -> str:
    if value is None:
        return "n/a"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
