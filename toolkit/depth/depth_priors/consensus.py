"""Depth on which several keyframes agree, and how accurate it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.loading import kernels
from toolkit.depth.depth_priors import native, reference
from toolkit.depth.depth_priors.problem import Consensus, Image, NeighbourView, check_images

# Relative standard deviation of fused depth, fitted to the errors on replica_office0 and on the
# synthetic rooms (benchmarks/results/multi_view_depth.md). It grows with the differences of the
# keyframes that agree, and with the reciprocal of the parallax; it is smaller where more keyframes
# agree, and where the images determine the plane better.
_FLOOR, _SPREAD, _PIXEL = 0.0011, 0.89, 0.226
_MARGIN, _MARGIN_OFFSET, _MARGIN_POWER = 0.05, 0.01, 0.44
_AGREEING, _AGREEING_POWER = 4.0, 0.93


@dataclass(frozen=True)
class AgreementOptions:
    """Which depth is kept.

    Attributes:
        tolerance: maximum relative difference to the depth of another keyframe.
        keyframes: number of keyframes that must agree, in addition to those that conflict.
        in_front: relative difference from which a keyframe that sees a surface behind a point
            conflicts with it.
    """

    tolerance: float = 0.02
    keyframes: int = 2
    in_front: float = 0.2


def find_consensus(
    camera: Camera,
    inverse_depth: Image,
    others: Sequence[NeighbourView],
    options: AgreementOptions | None = None,
) -> Consensus:
    """Compare the depth of an image with that of other images, and fuse those that agree.

    Args:
        camera: intrinsics of all images.
        inverse_depth: [H, W] of the image, 0 where unknown.
        others: inverse depths of other images, 0 where unknown.

    Raises:
        ValueError: sizes disagree.
    """
    options = options or AgreementOptions()
    check_images(camera, [inverse_depth, *(other.image for other in others)])
    limits = (options.tolerance, options.in_front)
    module = kernels()
    if module is None:
        return reference.find_consensus(camera, inverse_depth, others, limits)
    return native.find_consensus(module, camera, inverse_depth, others, limits)


def relative_sigma(consensus: Consensus, margin: Image) -> Image:
    """Relative standard deviation [H, W] of fused depth at known poses, inf where none agrees.

    Errors of the poses are not included: a wrong scale, which all keyframes share, is not visible
    to their comparison.

    Args:
        margin: [H, W], of the keyframe's own sweep.
    """
    pixel = _PIXEL / np.maximum(consensus.parallax_px, 1e-3)
    matching = np.sqrt(_FLOOR**2 + (_SPREAD * consensus.spread) ** 2 + pixel**2)
    weight = ((margin + _MARGIN_OFFSET) / _MARGIN) ** _MARGIN_POWER
    known = consensus.agreeing > 0
    weight *= (np.where(known, consensus.agreeing, 1.0) / _AGREEING) ** _AGREEING_POWER
    return np.where(known, matching / weight, np.inf).astype(np.float32)
