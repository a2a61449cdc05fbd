"""Gaussians of measured surfaces that keyframes hardly show, because others cover them.

They cost memory in every viewer and are worth nothing: without them, unseen views of a kitchen and
of a walk with a HoloLens are as good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.free_space import evidence_of_all
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering.backend import Backend

# Minimum weight of a Gaussian in the image of some keyframe, summed over its pixels.
_MIN_PIXELS = 0.25
# Weights are computed in images reduced by this factor, in a third of the time.
_REDUCTION = 2


def hidden(
    gaussians: GaussianCloud,
    keyframes: Sequence[Keyframe],
    backend: Backend,
    support: Tensor | None = None,
) -> Tensor:
    """Mask [N] of the Gaussians on measured surfaces that no keyframe shows in 0.25 pixels.

    What lies behind those surfaces is kept: a frame between keyframes may have seen it.

    Args:
        support: [N] number of the keyframes that measured a surface at each Gaussian; computed if
            it is not given.
    """
    shades = replace(
        gaussians,
        colours=torch.full_like(gaussians.colours, 0.5),
        ellipsoids=gaussians.ellipsoids and gaussians.ellipsoids.with_degree(0),
    )
    largest = gaussians.log_radii.new_zeros(len(gaussians))
    for keyframe in keyframes:
        camera = keyframe.camera.scaled(
            1 / _REDUCTION,
            1 / _REDUCTION,
            max(keyframe.camera.width // _REDUCTION, 1),
            max(keyframe.camera.height // _REDUCTION, 1),
        )
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        forward_pass = backend.forward(shades, camera, T_camera_map, None, None)
        # The derivative of the sum of a channel with respect to a colour is the sum of weights.
        sums = torch.zeros_like(forward_pass.images)
        sums[0] = 1.0
        gradients = forward_pass.backward(sums)
        assert gradients.colours is not None
        ids, weights = gradients.ids, _REDUCTION**2 * gradients.colours[:, 0]
        largest[ids] = torch.maximum(largest[ids], weights)
    if support is None:
        support = evidence_of_all(gaussians, keyframes).support
    return (largest < _MIN_PIXELS) & (support > 0)
