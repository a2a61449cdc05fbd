"""Derivatives of the depth loss by pixel, from the gradient of the whole mapping loss.

The sum of depths D and the silhouette S are compared with the observed depth as D / S, in the depth
loss alone. Its derivative by the rendered depth of a pixel is therefore the gradient of D times S.
"""

from __future__ import annotations

from torch import Tensor

from toolkit.native.constants import DEPTH_SUM, SILHOUETTE

_MIN_SILHOUETTE = 1e-6


def weigh_depth(gradient: Tensor, images: Tensor, mask: Tensor, weight: float) -> None:
    """Multiply the gradient of the depth loss by a weight in some pixels, in place.

    Args:
        gradient: [C, H, W] of the mapping loss by the rendered images.
        images: [C, H, W] the rendered images.
        mask: [H, W] bool, the pixels.
        weight: factor of the depth loss there; other losses keep theirs.
    """
    removed = (1.0 - weight) * gradient[DEPTH_SUM] * mask
    mean = images[DEPTH_SUM] / images[SILHOUETTE].clamp(min=_MIN_SILHOUETTE)
    gradient[DEPTH_SUM] -= removed
    # d(D / S) / dS = -(D / S) / S.
    gradient[SILHOUETTE] += removed * mean


def by_observed_depth(gradient: Tensor, images: Tensor) -> Tensor:
    """Derivative [H, W] of the depth loss, summed over pixels, by the observed depth.

    Args:
        gradient: [C, H, W] of the mapping loss by the rendered images.
        images: [C, H, W] the rendered images.
    """
    return -gradient[DEPTH_SUM] * images[SILHOUETTE]
