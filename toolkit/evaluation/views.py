"""How well a map reproduces views: colour, structure, depth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.evaluation.depth import depth_l1
from toolkit.evaluation.images import lpips, mean_or_none, ms_ssim, psnr_db, ssim
from toolkit.frame import Frame
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.rendering import render


@dataclass(frozen=True)
class View:
    """A frame, where it was taken, and its exposure against the map (map = gain * rgb + bias)."""

    frame: Frame
    T_map_camera: NDArray[np.float64]
    gain: float = 1.0
    bias: float = 0.0


@dataclass(frozen=True)
class ViewScores:
    """Means over views; None where nothing could be measured.

    Attributes:
        views: how many were scored.
        psnr_db: mean of the per-view dB over all pixels, holes of the depth included.
        ssim, ms_ssim, lpips: means of the per-view values.
        depth_l1_cm: mean over views of the mean over pixels with measured and rendered depth.
        depth_coverage: share of measured pixels that the map covers.
    """

    views: int
    psnr_db: float | None
    ssim: float | None
    ms_ssim: float | None
    lpips: float | None
    depth_l1_cm: float | None
    depth_coverage: float | None


def score_views(
    gaussians: GaussianCloud, views: Iterable[View], backend_name: str = "auto"
) -> ViewScores:
    """Render every view and compare it with what the camera saw."""
    rows: list[tuple[float | None, ...]] = []
    for view in views:
        T_camera_map = se3.inverse(view.T_map_camera)
        with torch.no_grad():
            drawn = render(gaussians, view.frame.camera, T_camera_map, backend_name=backend_name)
        # Back to the camera's own exposure, so that the observed image stays as it is.
        colour = ((drawn.colour - view.bias) / view.gain).clamp(0.0, 1.0)
        covered = torch.where(
            drawn.silhouette > 0.5, drawn.depth_m, torch.zeros_like(drawn.depth_m)
        )
        depth = depth_l1(covered.numpy(), view.frame.depth_m)
        l1_cm = None if depth.l1_m is None else 100.0 * depth.l1_m
        observed = view.frame.rgb
        rows.append(
            (
                psnr_db(colour, observed),
                ssim(colour, observed),
                ms_ssim(colour, observed),
                lpips(colour, observed),
                l1_cm,
                depth.coverage,
            )
        )
    columns = [mean_or_none([row[k] for row in rows]) for k in range(6)]
    return ViewScores(len(rows), *columns)
