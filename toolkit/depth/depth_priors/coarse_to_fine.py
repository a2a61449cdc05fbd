"""Plane sweep from coarse to fine: all depths at half the resolution, then a narrow band of depths
around those at full resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.loading import kernels
from toolkit.depth.depth_priors import native, reference
from toolkit.depth.depth_priors.plane_sweep import double_depth, plane_sweep
from toolkit.depth.depth_priors.problem import Image, NeighbourView, Planes, SweepOptions

# Motion in the half image from one plane to the next, for the source with the longest baseline.
_STEP_PX = 1.0
_MIN_PLANES, _MAX_PLANES = 24, 160
# Planes of the band, and their distance relative to that of the half image's planes: half a pixel.
_BAND, _BAND_STEP = 9, 0.25
# Larger steps, in planes of the half image, separate surfaces.
_MAX_STEP = 2.0
# Steps between planes of the band are smaller than between those of the half image.
_COARSE = SweepOptions(step_penalty=0.04, jump_penalty=0.4)
_FINE = SweepOptions(step_penalty=0.02, jump_penalty=0.4)
# Width of the wrong borders: half a window of the image of half the size.
_WIDTH = 6
# Ratio of the inverse depths of neighbouring pixels on different surfaces.
_EDGE = 1.05


@dataclass(frozen=True)
class ImagePair:
    """An image and its half.

    Attributes:
        full: [H, W] float32 intensity in [0, 1].
        half: [H // 2, W // 2] float32, averages of 2x2 pixels.
    """

    full: Image
    half: Image


@dataclass(frozen=True)
class Source:
    """Another view of the scene.

    Attributes:
        images: of the view.
        T_source_reference: [4, 4].
        coarse: whether it is used at half the resolution, too.
    """

    images: ImagePair
    T_source_reference: NDArray[np.float64]
    coarse: bool = True


@dataclass(frozen=True)
class SweptDepth:
    """Depth of an image from the images around it.

    Attributes:
        inverse_depth: [H, W] float32 inverse z-depth, 0 where unknown.
        margin: [H, W] float32 in [0, 1], by which it fits better than others of the band.
    """

    inverse_depth: Image
    margin: Image


def image_pair(intensity: Image) -> ImagePair:
    """An image [H, W] with its half; an odd last row or column is dropped."""
    height, width = (n // 2 for n in intensity.shape)
    even = intensity[: 2 * height, : 2 * width]
    half = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
    return ImagePair(np.ascontiguousarray(intensity), np.ascontiguousarray(half, np.float32))


def sweep_depth(
    camera: Camera,
    images: ImagePair,
    sources: Sequence[Source],
    inverse_depths: tuple[float, float],
) -> SweptDepth:
    """Find the depth at which an image agrees best with the images around it.

    Args:
        camera: intrinsics of all full images, at least 4x4 pixels.
        images: of the reference view.
        sources: other views, at least one of them coarse.
        inverse_depths: of the farthest and the nearest plane.
    """
    far, near = inverse_depths
    step, half = _half_depth(camera, images, sources, far, near)
    middle = double_depth(half, images.half, images.full, _MAX_STEP * step)
    fine = _BAND_STEP * step
    first = middle - np.float32(0.5 * (_BAND - 1) * fine)
    posed = [NeighbourView(s.images.full, s.T_source_reference) for s in sources]
    found = plane_sweep(camera, images.full, posed, Planes(first, fine, _BAND), _FINE)
    inverse_depth = first + found.plane * np.float32(fine)
    known = (middle > 0) & (found.plane >= 0) & (inverse_depth > 0.5 * far)
    known &= inverse_depth > 0
    inverse_depth = np.where(known, inverse_depth, np.float32(0.0))
    inverse_depth = remove_fattening(images.full, inverse_depth)
    return SweptDepth(inverse_depth, found.margin)


def _half_depth(
    camera: Camera, images: ImagePair, sources: Sequence[Source], far: float, near: float
) -> tuple[float, Image]:
    """Step between planes, and inverse depth of the half image, 0 where unknown."""
    coarse = [s for s in sources if s.coarse]
    baseline = max((float(np.linalg.norm(s.T_source_reference[:3, 3])) for s in sources), default=0)
    motion_px = 0.5 * baseline * camera.focal * (near - far)
    count = int(np.clip(np.ceil(motion_px / _STEP_PX), _MIN_PLANES, _MAX_PLANES))
    step = (near - far) / (count - 1)
    planes = Planes(np.full_like(images.half, far), step, count)
    posed = [NeighbourView(s.images.half, s.T_source_reference) for s in coarse]
    found = plane_sweep(camera.halved(), images.half, posed, planes, _COARSE)
    # Surfaces at the last plane may be nearer.
    known = (found.plane >= 0) & (found.plane < count - 1)
    inverse_depth = np.float32(far) + found.plane * np.float32(step)
    return step, np.where(known, inverse_depth, np.float32(0.0))


def remove_fattening(intensity: Image, inverse_depth: Image) -> Image:
    """Remove the depth of pixels that belong to the surface behind the one of their depth.

    Pixels on the near side of a depth edge are compared with both surfaces, of which they have the
    intensity that is more frequent there.

    Args:
        intensity: [H, W] float32 in [0, 1].
        inverse_depth: [H, W] float32, 0 where unknown.

    Returns:
        [H, W] float32 inverse depth, 0 where unknown or removed.
    """
    # A 3x3 window beside a depth edge shows what is behind it.
    known = np.where(inverse_depth > 0, inverse_depth, np.float32(np.inf))
    far = _least(known, 3)
    edge = (known < np.inf) & (known > np.float32(_EDGE) * far)
    behind = _least(np.where(edge, far, np.float32(np.inf)), 2 * _WIDTH + 1)
    module = kernels()
    if module is None:
        return reference.remove_fattening(intensity, inverse_depth, behind)
    return native.remove_fattening(module, intensity, inverse_depth, behind)


def _least(image: Image, side: int) -> Image:
    """Least value [H, W] of the square around each pixel."""
    square = np.ones((side, side), np.uint8)
    return np.asarray(cv2.erode(image, square, borderType=cv2.BORDER_REPLICATE), np.float32)
