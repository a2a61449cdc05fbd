"""Input and results of plane sweeps and of their comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera

Image = NDArray[np.float32]


@dataclass(frozen=True)
class NeighbourView:
    """An image of another view.

    Attributes:
        image: [H, W] float32, intensity in [0, 1] or inverse depth.
        T_other_reference: [4, 4] pose of the reference view in the other one.
    """

    image: Image
    T_other_reference: NDArray[np.float64]


@dataclass(frozen=True)
class Planes:
    """Inverse depths that are compared: `first + d * step` for d in [0, count).

    Attributes:
        first: [H, W] float32, of each pixel; those of a slanted surface differ.
        step: > 0.
        count: at least 2.
    """

    first: Image
    step: float
    count: int


@dataclass(frozen=True)
class SweepOptions:
    """Semi-global matching.

    Attributes:
        step_penalty, jump_penalty: of neighbouring pixels on neighbouring planes, and on planes
            farther apart, relative to the highest matching cost.
    """

    step_penalty: float = 0.04
    jump_penalty: float = 0.4


@dataclass(frozen=True)
class SweptPlanes:
    """Result of a plane sweep.

    Attributes:
        plane: [H, W] float32 position in [0, count - 1], -1 if no source shows the pixel.
        correlation: [H, W] float32 in [0, 1], of the images at the chosen plane.
        margin: [H, W] float32 in [0, 1], by which the chosen plane fits better than any other.
    """

    plane: Image
    correlation: Image
    margin: Image


@dataclass(frozen=True)
class Consensus:
    """Depth of an image, compared with that of other images; 0 where the depth is unknown.

    Attributes:
        inverse_depth: [H, W] float32, mean of the image's and of those that agree.
        spread: [H, W] float32, their relative standard deviation.
        parallax_px: [H, W] float32, largest motion of a pixel in another image if its depth
            changes by a small fraction, divided by the fraction.
        agreeing: [H, W] float32, number of other images that agree.
        conflicting: [H, W] float32, number of other images that see a surface behind the point.
    """

    inverse_depth: Image
    spread: Image
    parallax_px: Image
    agreeing: Image
    conflicting: Image


def check_images(camera: Camera, images: Sequence[Image]) -> None:
    """Check that images can be passed to a kernel.

    Raises:
        ValueError: an image has another shape or type, or the camera has less than 2x2 pixels.
    """
    shape = (camera.height, camera.width)
    if min(shape) < 2:
        raise ValueError(f"images must have at least 2x2 pixels, got {list(shape)}")
    for image in images:
        if image.shape != shape or image.dtype != np.float32 or not image.flags.c_contiguous:
            raise ValueError(
                f"images must be contiguous float32 of shape {list(shape)}, "
                f"got {image.dtype} {list(image.shape)}"
            )
