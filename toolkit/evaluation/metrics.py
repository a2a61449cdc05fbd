"""Metrics of a run as a flat dictionary with units and conventions.

Published results differ in alignment, masks and the variant of SSIM, so each group of metrics
includes its convention. A metric that is not available is None (null in the file), never 0.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.evaluation.depth import depth_l1
from toolkit.evaluation.images import masked_psnr_db, mean_or_none, psnr_db, ssim_and_ms_ssim
from toolkit.evaluation.lpips import Lpips
from toolkit.evaluation.trajectory import (
    MAX_TIME_DIFFERENCE_S,
    AlignmentKind,
    absolute_trajectory_error,
    relative_pose_error,
)
from toolkit.evaluation.white_balance import balanced
from toolkit.geometry.trajectory import Trajectory
from toolkit.io import atomic
from toolkit.stages import Column

MetricValue = float | int | str | None
Metrics = dict[str, MetricValue]

IMAGE_CONVENTIONS: Metrics = {
    "psnr_convention": "mean of per-view dB over all pixels, at most 100 dB a view; measured and "
    "inferred: over the pixels with and without measured depth, of the views that have any; "
    "one_gain: without the white balance that the run estimated for the view; per_channel: after "
    "fitting one gain per channel",
    "ssim_convention": "11x11 Gaussian window of sigma 1.5, data range 1, mirrored border",
    "ms_ssim_convention": "5 scales; null where the shorter side is below 176 pixels",
    "lpips_convention": "AlexNet, version 0.1; null without --lpips-weights, and for images below "
    "31 pixels a side",
    "depth_l1_convention": "mean over views of the mean over pixels with measured and rendered "
    "depth",
}


@dataclass(frozen=True)
class ViewQuality:
    """Image and depth quality of one rendered view; None where a metric is not available.

    Attributes:
        psnr_db: over all pixels, in dB.
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
        frames: number of processed frames.
        frames_lost: number of frames without a pose.
        keyframes, gaussians: numbers in the final map.
        columns_ms: total time of each column over all frames, in milliseconds.
        refinement_ms: time of the refinement after them.
        online_ms: wall-clock time of the loop over all frames: the columns, waiting for images,
            checkpoints, and everything else.
        total_ms: the same with everything after the last frame, without evaluation.
        peak_memory_mb: peak resident memory of the process, in MB.
        map_mb: size of the map's parameters, in MB.
    """

    frames: int
    frames_lost: int
    keyframes: int
    gaussians: int
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
) -> ViewQuality:
    """Evaluate one view.

    Args:
        rendered: colour [H, W, 3] in [0, 1] and surface depth [H, W] in metres, 0 where no
            surface was rendered.
        measured: colour and depth of the frame, depth 0 where missing.
        lpips: network of LPIPS, or None without its weights.

    Raises:
        ValueError: shapes differ.
    """
    rgb, depth_m = rendered
    true_rgb, measured_depth_m = measured
    depth = depth_l1(depth_m, measured_depth_m)
    similarity, multi_scale = ssim_and_ms_ssim(rgb, true_rgb)
    return ViewQuality(
        psnr_db=psnr_db(rgb, true_rgb),
        ssim=similarity,
        ms_ssim=multi_scale,
        lpips=None if lpips is None else lpips(rgb, true_rgb),
        depth_l1_m=depth.l1_m,
        depth_coverage=depth.coverage,
        psnr_measured_db=masked_psnr_db(rgb, true_rgb, measured_depth_m > 0),
        psnr_inferred_db=masked_psnr_db(rgb, true_rgb, ~(measured_depth_m > 0)),
        psnr_per_channel_db=psnr_db(balanced(rgb, true_rgb), true_rgb),
    )


def trajectory_metrics(
    estimate: Trajectory, truth: Trajectory | None, alignment: AlignmentKind = "se3"
) -> Metrics:
    """Compute ATE and RPE in centimetres and degrees; None without ground truth.

    Raises:
        DatasetError: there is ground truth, but no poses can be associated in time.
    """
    convention: Metrics = {
        "ate_alignment": alignment,
        "ate_max_time_difference_s": MAX_TIME_DIFFERENCE_S,
        "rpe_delta_frames": 1,
        "rpe_convention": "root mean square over steps between neighbouring tracked frames",
    }
    keys = ("ate_rmse_cm", "ate_mean_cm", "ate_median_cm", "ate_max_cm", "ate_pairs")
    rpe_keys = ("rpe_translation_cm", "rpe_rotation_deg")
    if truth is None or len(truth) == 0 or len(estimate) == 0:
        return convention | dict.fromkeys((*keys, *rpe_keys))
    ate = absolute_trajectory_error(estimate, truth, alignment)
    metres = (ate.rmse_m, ate.mean_m, ate.median_m, ate.max_m)
    values: Metrics = dict(zip(keys, (*(100.0 * m for m in metres), ate.pairs), strict=True))
    if alignment == "sim3":
        estimate = ate.alignment.applied_to(estimate)
        values["ate_scale"] = ate.alignment.scale
    rpe = relative_pose_error(estimate, truth)
    values["rpe_translation_cm"] = 100.0 * rpe.translation_rmse_m if rpe else None
    values["rpe_rotation_deg"] = rpe.rotation_rmse_deg if rpe else None
    return convention | values


def image_metrics(views: Sequence[ViewQuality], suffix: str = "") -> Metrics:
    """Compute means over views: `psnr{suffix}_db`, `ssim{suffix}` etc.

    Args:
        views: views of one group; all means are None without views.
        suffix: "" for mapped views, "_unseen" for views excluded from mapping.
    """
    depth_l1_m = mean_or_none([view.depth_l1_m for view in views])
    coverage = mean_or_none([view.depth_coverage for view in views])
    return {
        f"views{suffix}": len(views),
        f"psnr{suffix}_db": mean_or_none([view.psnr_db for view in views]),
        **{
            f"psnr{suffix}_{kind}_db": mean_or_none([getattr(v, f"psnr_{kind}_db") for v in views])
            for kind in ("measured", "inferred", "one_gain", "per_channel")
        },
        f"ssim{suffix}": mean_or_none([view.ssim for view in views]),
        f"ms_ssim{suffix}": mean_or_none([view.ms_ssim for view in views]),
        f"lpips{suffix}": mean_or_none([view.lpips for view in views]),
        f"depth_l1{suffix}_cm": None if depth_l1_m is None else 100.0 * depth_l1_m,
        f"depth_coverage{suffix}_percent": None if coverage is None else 100.0 * coverage,
    }


def cost_metrics(costs: RunCosts) -> Metrics:
    """Return counts, mean times per frame and memory.

    The columns and `other_ms_per_frame` add up to `online_ms_per_frame`.
    """
    known_ms = sum(costs.columns_ms.values())
    per_frame: dict[str, float | None] = {
        f"{column}_ms_per_frame": ms for column, ms in costs.columns_ms.items()
    }
    per_frame |= {
        "other_ms_per_frame": None if costs.online_ms is None else costs.online_ms - known_ms,
        "refinement_ms_per_frame": costs.refinement_ms,
        "online_ms_per_frame": costs.online_ms,
        "total_ms_per_frame": costs.total_ms,
    }
    frames = max(costs.frames, 1)
    return {
        "frames": costs.frames,
        "frames_lost": costs.frames_lost,
        "keyframes": costs.keyframes,
        "gaussians": costs.gaussians,
        **{key: None if total is None else total / frames for key, total in per_frame.items()},
        "timing_convention": "total over all frames divided by the number of frames",
        "peak_memory_mb": costs.peak_memory_mb,
        "map_mb": costs.map_mb,
    }


def write_metrics(path: str | os.PathLike[str], metrics: Metrics) -> None:
    """Write metrics.json atomically, with sorted keys and null for metrics not available.

    Raises:
        RunFolderError: the file cannot be written.
    """
    finite = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in metrics.items()
    }
    text = json.dumps(finite, indent=2, sort_keys=True, allow_nan=False)
    atomic.write_bytes(path, (text + "\n").encode())


def read_metrics(path: str | os.PathLike[str]) -> Metrics:
    """Read metrics.json.

    Raises:
        FormatError: the file is missing or does not contain a dictionary.
    """
    try:
        metrics = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FormatError(
            f"{path} cannot be read as metrics ({error}); create it again with: semsplat evaluate"
        ) from error
    if not isinstance(metrics, dict):
        raise FormatError(
            f"{path} does not contain a dictionary; create it again with: semsplat evaluate"
        )
    return metrics
