"""Density control: where Gaussians are missing, and which are of no use."""

from __future__ import annotations

import torch
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.rendering import SurfaceView


def missing(
    view: SurfaceView, depth_m: Tensor, min_silhouette: float, floor: float, factor: float
) -> Tensor:
    """Pixels [H, W] that a map does not explain (H, densification).

    Args:
        view: the map. depth_m: [H, W] as measured, 0 missing.
        min_silhouette: a thinner map explains nothing.
        floor, factor: nor does one that lies behind the measured depth by more than this share
            of it, and by more than so many medians of the error.
    """
    measured = depth_m > 0
    thin = view.output.silhouette < min_silhouette
    behind = torch.where(measured & ~thin, view.depth_m - depth_m, torch.zeros_like(depth_m))
    errors = behind.abs()[measured & ~thin]
    median = float(errors.median()) if errors.numel() else 0.0
    threshold = (floor * depth_m).clamp(min=factor * median)
    return measured & (thin | (behind > threshold))


def useless(gaussians: GaussianCloud, min_opacity: float, max_radius_m: float) -> Tensor:
    """[N] bool, those that are invisible, far too large or not finite."""
    bad = gaussians.opacities < min_opacity
    bad |= gaussians.radii_m > max_radius_m
    bad |= ~torch.isfinite(gaussians.means).all(dim=1)
    return bad
