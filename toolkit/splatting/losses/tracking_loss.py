"""The papers' tracking loss with its derivative (H-22, G-2).

Both are sums over pixels of L1 norms. A pixel has three colours and one depth, so means over pixels
and channels would have other relative weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.base.native.constants import DEPTH_SUM, SILHOUETTE
from toolkit.splatting.rendering.output import COLOUR


@dataclass(frozen=True)
class TrackingLossWeights:
    """Weights of the tracking loss.

    Attributes:
        colour, depth: weights of the two L1 terms.
        semantic: weight of the code's loss for the frame's labels; 0 disables it.
        min_silhouette: the loss includes pixels with a larger silhouette only.
    """

    colour: float
    depth: float
    semantic: float
    min_silhouette: float = 0.99


PRESETS = {
    "hier-slam": TrackingLossWeights(colour=0.5, depth=1.0, semantic=0.0),
    "gausem": TrackingLossWeights(colour=1.0, depth=0.5, semantic=0.5),
}


@dataclass(frozen=True)
class TrackingLoss:
    """Tracking loss of one rendered view.

    Attributes:
        value: sum over the valid pixels; 0 without any.
        per_pixel: loss per valid pixel, used to compare poses, because a sum would favour poses
            that show little of the map. Infinite without valid pixels.
        gradient: [5 + S, H, W] derivative of `value` with respect to the rendered images.
        pixels: number of valid pixels.
    """

    value: float
    per_pixel: float
    gradient: Tensor
    pixels: int


def tracking_loss(
    images: Tensor, rgb: Tensor, depth_m: Tensor, weights: TrackingLossWeights
) -> TrackingLoss:
    """Compute the loss of a rendered view where the map is opaque and depth was measured.

    Args:
        images: [5 + S, H, W] as rendered by a backend.
        rgb: [3, H, W] observed colour. depth_m: [H, W] observed depth, 0 where missing.
    """
    silhouette, depth_sum = images[SILHOUETTE], images[DEPTH_SUM]
    mask = (silhouette > weights.min_silhouette) & (depth_m > 0)
    pixels = int(mask.sum())
    gradient = torch.zeros_like(images)
    if pixels == 0:
        return TrackingLoss(0.0, float("inf"), gradient, 0)
    difference = torch.where(mask, images[COLOUR] - rgb, torch.zeros_like(rgb))
    inverse = torch.where(mask, 1.0 / silhouette, torch.zeros_like(silhouette))
    error = torch.where(mask, depth_sum * inverse - depth_m, torch.zeros_like(depth_m))
    value = weights.colour * float(difference.abs().sum())
    value += weights.depth * float(error.abs().sum())
    gradient[COLOUR] = torch.sign(difference) * weights.colour
    by_sum = torch.sign(error) * inverse * weights.depth
    gradient[DEPTH_SUM] = by_sum
    gradient[SILHOUETTE] = -by_sum * depth_sum * inverse
    return TrackingLoss(value, value / pixels, gradient, pixels)
