"""Opacity of a map in space that held-out frames measured as empty.

Unlike the floaters of `walls.py`, this needs no true mesh: the depth of frames that the map was not
built from shows where space is empty.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from toolkit.base.geometry.free_space import FREE_SPACE, FREE_SPACE_M, free_space_margin_m
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.slam.mapping.depth_views import DepthView
from toolkit.splatting.gaussians.scene import GaussianScene

FREE_SPACE_CONVENTION = (
    "share of the opacity of all Gaussians; empty: in front of the measured depth by more than "
    f"the larger of {100 * FREE_SPACE_M:.0f} cm and {100 * FREE_SPACE:.0f} %; of Gaussians that "
    "more held-out frames measured through than measured a surface at their place, frames with a "
    "depth edge or missing depth beside their pixel left out; 'any': of Gaussians that at least "
    "one held-out frame measured through, whatever is beside the pixel"
)


def free_space_metrics(scene: GaussianScene, views: Iterable[DepthView]) -> Metrics:
    """Measure the share of a map's opacity in empty space; None without views.

    Args:
        views: depth of the held-out frames at their poses in the frame of the map.
    """
    views = list(views)
    total, inside = 0.0, [0.0, 0.0]
    for part in scene.parts() if views else ():
        opacities = part.opacities.double()
        total += float(opacities.sum())
        for number, mask in enumerate(_in_empty_space(part.means, views)):
            inside[number] += float(opacities[mask].sum())
    shares = [100.0 * value / total if total else None for value in inside]
    return {
        "opacity_percent": shares[0],
        "opacity_any_percent": shares[1],
        "convention": FREE_SPACE_CONVENTION,
    }


def _in_empty_space(means: Tensor, views: list[DepthView]) -> tuple[Tensor, Tensor]:
    """Masks [N] of the points [N, 3] that most views, and that any view measured through."""
    votes = torch.zeros(len(means), dtype=torch.int32)
    anywhere = torch.zeros(len(means), dtype=torch.bool)
    for view in views:
        chosen, pixel, z = view.pixels_of(means)
        depth = torch.from_numpy(view.depth_m.reshape(-1)).index_select(0, pixel)
        surely_empty = torch.from_numpy(view.image.empty_m.reshape(-1))
        through = z < surely_empty.index_select(0, pixel)
        margin = free_space_margin_m(depth)
        surface = (depth > 0) & ((z - depth).abs() <= margin)
        votes.index_add_(0, chosen, through.int() - surface.int())
        anywhere[chosen] |= (depth > 0) & (z < depth - margin)
    return votes > 0, anywhere
