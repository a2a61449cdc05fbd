"""Metrics of a run as nested dictionaries, one for each subject, with units and conventions.

Published results differ in alignment, masks and the variant of SSIM, so each group of metrics
includes its convention. A metric that is not available is None (null in the file), never 0.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.stages import Column
from toolkit.io import atomic
from toolkit.io.guarded.documents import read_json
from toolkit.runs.evaluation.depth import depth_l1
from toolkit.runs.evaluation.images import (
    balanced,
    masked_psnr_db,
    mean_or_none,
    psnr_db,
    ssim_and_ms_ssim,
)
from toolkit.runs.evaluation.lpips import Lpips
from toolkit.runs.evaluation.trajectory import (
    MAX_TIME_DIFFERENCE_S,
    AlignmentKind,
    absolute_trajectory_error,
    relative_pose_error,
)
from toolkit.runs.evaluation.true_poses import pose_delay, pose_scale

MetricValue = float | int | str | None
# Values are of type MetricValue or Metrics.
Metrics = dict[str, Any]

IMAGE_CONVENTIONS: Metrics = {
    "psnr": "mean of per-view dB over all pixels, at most 100 dB a view; measured and inferred: "
    "over the pixels with and without measured depth, of the views that have any; one_gain: "
    "without the white balance that the run estimated for the view; per_channel: after fitting one "
    "gain per channel",
    "ssim": "11x11 Gaussian window of sigma 1.5, data range 1, mirrored border",
    "ms_ssim": "5 scales; null where the shorter side is below 176 pixels",
    "lpips": "AlexNet, version 0.1; null without --lpips-weights, and for images below 31 pixels a "
    "side",
}


@dataclass(frozen=True)
class ViewQuality:
    """Image and depth quality of one rendered view; None where a metric is not available.

    Attributes:
        psnr_db: over all pixels that are not ignored, in dB.
        psnr_measured_db, psnr_inferred_db: over the pixels with and without measured depth.
        psnr_one_gain_db: over all pixels, rendered at the gain and bias of the view only, without
            the white balance that the run estimated for it.
        psnr_per_channel_db: over all pixels, after fitting one gain per channel.
        ssim, ms_ssim, lpips: without unit.
        depth_l1_m: mean absolute depth error in metres.
        depth_coverage: fraction of the pixels with measured depth that were compared, in [0, 1].
    """

    psnr_db: float
    ssim: float | None
    ms_ssim: float | None
    lpips: float | None
    depth_l1_m: float | None
    depth_coverage: float
    psnr_measured_db: float | None = None
    psnr_inferred_db: float | None = None
    psnr_one_gain_db: float | None = None
    psnr_per_channel_db: float | None = None


@dataclass(frozen=True)
class RunCosts:
    """Total times and memory of a run; None where not measured.

    Attributes:
        frames: number of frames of the sequence.
        columns_ms: total time of each column over all frames, in milliseconds.
        refinement_ms: time of the refinement after them.
        online_ms: wall-clock time of the loop over all frames: the columns, waiting for images,
            checkpoints, and everything else.
        total_ms: the same with everything after the last frame, without evaluation.
        peak_memory_mb: peak resident memory of the process, in MB.
        map_mb: size of the map's parameters, in MB.
    """

    frames: int
    columns_ms: Mapping[Column, float]
    refinement_ms: float | None
    online_ms: float | None
    total_ms: float | None
    peak_memory_mb: float | None
    map_mb: float | None


def view_quality(
    rendered: tuple[NDArray[np.float32], NDArray[np.float32]],
    measured: tuple[NDArray[np.float32], NDArray[np.float32]],
    lpips: Lpips | None = None,
    ignored: NDArray[np.bool_] | None = None,
) -> ViewQuality:
    """Evaluate one view.

    Args:
        rendered: colour [H, W, 3] in [0, 1] and surface depth [H, W] in metres, 0 where no
            surface was rendered.
        measured: colour and depth of the frame, depth 0 where missing.
        lpips: network of LPIPS, or None without its weights.
        ignored: [H, W] pixels that are not mapped: PSNR leaves them out, and they count as equal
            in other similarities. None for none.

    Raises:
        ValueError: shapes differ.
    """
    rgb, depth_m = rendered
    true_rgb, measured_depth_m = measured
    measured_pixels = measured_depth_m > 0
    other_pixels = ~measured_pixels
    if ignored is not None:
        rgb = np.where(ignored[..., None], true_rgb, rgb)
        other_pixels &= ~ignored
    depth = depth_l1(depth_m, measured_depth_m)
    similarity, multi_scale = ssim_and_ms_ssim(rgb, true_rgb)
    return ViewQuality(
        psnr_db=psnr_db(rgb, true_rgb, ignored),
        ssim=similarity,
        ms_ssim=multi_scale,
        lpips=None if lpips is None else lpips(rgb, true_rgb),
        depth_l1_m=depth.l1_m,
        depth_coverage=depth.coverage,
        psnr_measured_db=masked_psnr_db(rgb, true_rgb, measured_pixels),
        psnr_inferred_db=masked_psnr_db(rgb, true_rgb, other_pixels),
        psnr_per_channel_db=psnr_db(balanced(rgb, true_rgb), true_rgb, ignored),
    )


def trajectory_metrics(
    estimate: Trajectory, truth: Trajectory | None, alignment: AlignmentKind = "se3"
) -> Metrics:
    """Compute ATE and RPE in centimetres and degrees.

    They are None without ground truth, and with the alignment "none": the poses are the true ones.

    Raises:
        DatasetError: there is ground truth, but no poses can be associated in time.
    """
    keys = ("ate_rmse_cm", "ate_mean_cm", "ate_median_cm", "ate_max_cm", "ate_pairs")
    rpe_keys = ("rpe_translation_cm", "rpe_rotation_deg")
    delay_keys = ("truth_delay_s", "ate_rmse_without_delay_cm")
    scale_keys = ("truth_scale", "ate_rmse_at_scale_cm")
    metrics: Metrics = dict.fromkeys((*keys, *rpe_keys, *delay_keys, *scale_keys)) | {
        "alignment": alignment,
        "convention": f"tracked frames with ground truth within {MAX_TIME_DIFFERENCE_S:g} s; RPE: "
        "root mean square over steps between neighbouring ones",
    }
    if alignment == "none" or truth is None or len(truth) == 0 or len(estimate) == 0:
        return metrics
    delay = pose_delay(estimate, truth, alignment)
    if delay is not None:
        metrics |= zip(delay_keys, (delay.delay_s, 100.0 * delay.rmse_m), strict=True)
    scale = pose_scale(estimate, truth) if alignment == "se3" else None
    if scale is not None:
        metrics |= zip(scale_keys, (scale.factor, 100.0 * scale.rmse_m), strict=True)
    ate = absolute_trajectory_error(estimate, truth, alignment)
    metres = (ate.rmse_m, ate.mean_m, ate.median_m, ate.max_m)
    metrics |= zip(keys, (*(100.0 * m for m in metres), ate.pairs), strict=True)
    if alignment == "sim3":
        estimate = ate.alignment.applied_to(estimate)
        metrics["scale"] = ate.alignment.scale
    rpe = relative_pose_error(estimate, truth)
    if rpe is not None:
        metrics["rpe_translation_cm"] = 100.0 * rpe.translation_rmse_m
        metrics["rpe_rotation_deg"] = rpe.rotation_rmse_deg
    return metrics


def truth_lines(metrics: Metrics) -> list[str]:
    """Name a wrong clock or unit of the true poses, from `trajectory_metrics`; a line each."""
    delay_s, scale, ate_cm = (metrics[k] for k in ("truth_delay_s", "truth_scale", "ate_rmse_cm"))
    lines = []
    if delay_s is not None:
        late, right_cm = "late" if delay_s > 0 else "early", metrics["ate_rmse_without_delay_cm"]
        lines.append(
            f"The true poses are {abs(delay_s):.3f} s {late}: ATE is {ate_cm:.2f} cm, and "
            f"{right_cm:.2f} cm with --dataset.pose-delay {delay_s:.3f}."
        )
    if scale is not None:
        lines.append(
            f"Depth and true poses are in different units: ATE is {ate_cm:.2f} cm, and "
            f"{metrics['ate_rmse_at_scale_cm']:.2f} cm if depth is multiplied by {scale:.3f}."
        )
    return lines


def ate_frames(values: Mapping[str, Any]) -> str:
    """Text like "over 3 of 40 frames", if the ATE is that of a part of the frames; else empty.

    Args:
        values: metrics by dotted keys.
    """
    pairs, frames = values.get("trajectory.ate_pairs"), values.get("frames.total")
    if pairs is None or frames is None or pairs >= frames:
        return ""
    return f"over {pairs} of {frames} frames"


def ate_warnings(metrics: Metrics) -> list[str]:
    """A line about an ATE of less than half of the frames; none if it is that of more."""
    values = flattened(metrics)
    text = ate_frames(values)
    if not text or 2 * values["trajectory.ate_pairs"] >= values["frames.total"]:
        return []
    return [
        f"The trajectory error (ATE {values['trajectory.ate_rmse_cm']:.2f} cm) is measured {text} "
        f"only: the others have no pose in the main part of the map, or no true pose."
    ]


def image_metrics(views: Sequence[ViewQuality]) -> Metrics:
    """Compute means over a group of views; None without views."""
    names = (
        *("psnr_db", "psnr_measured_db", "psnr_inferred_db", "psnr_one_gain_db"),
        *("psnr_per_channel_db", "ssim", "ms_ssim", "lpips"),
    )
    means = {name: mean_or_none([getattr(view, name) for view in views]) for name in names}
    return {"views": len(views), **means}


def depth_metrics(views: Sequence[ViewQuality]) -> Metrics:
    """Compute means over a group of views; None without views."""
    l1_m = mean_or_none([view.depth_l1_m for view in views])
    coverage = mean_or_none([view.depth_coverage for view in views])
    return {
        "l1_cm": None if l1_m is None else 100.0 * l1_m,
        "coverage_percent": None if coverage is None else 100.0 * coverage,
    }


def cost_metrics(costs: RunCosts) -> Metrics:
    """Return mean times per frame and memory.

    The columns and `other_ms_per_frame` add up to `online_ms_per_frame`.
    """
    known_ms = sum(costs.columns_ms.values())
    total_ms: dict[str, float | None] = {str(name): ms for name, ms in costs.columns_ms.items()}
    total_ms |= {
        "other": None if costs.online_ms is None else costs.online_ms - known_ms,
        "refinement": costs.refinement_ms,
        "online": costs.online_ms,
        "total": costs.total_ms,
    }
    frames = max(costs.frames, 1)
    per_frame = {
        f"{name}_ms_per_frame": None if ms is None else ms / frames for name, ms in total_ms.items()
    }
    convention = "total over all frames divided by the number of frames"
    return {
        "time": {**per_frame, "convention": convention},
        "memory": {"peak_mb": costs.peak_memory_mb, "map_mb": costs.map_mb},
    }


def flattened(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested dictionaries by dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def write_metrics(path: str | os.PathLike[str], metrics: Metrics) -> None:
    """Write metrics.json atomically, with sorted keys and null for metrics not available.

    Raises:
        RunFolderError: the file cannot be written.
    """
    text = json.dumps(_finite(metrics), indent=2, sort_keys=True, allow_nan=False)
    atomic.write_text(path, text + "\n")


def _finite(value: Any) -> Any:
    """The value, or nested dictionaries, with None for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_metrics(path: str | os.PathLike[str]) -> Metrics:
    """Read metrics.json.

    Raises:
        FormatError: the file is missing or does not contain a dictionary.
    """
    try:
        metrics = read_json(path)
    except (OSError, ValueError) as error:
        raise FormatError(
            f"{path} cannot be read as metrics ({error}); create it again with: semsplat evaluate"
        ) from error
    if not isinstance(metrics, dict):
        raise FormatError(
            f"{path} does not contain a dictionary; create it again with: semsplat evaluate"
        )
    return metrics
