"""Dense depth of an image from other images at known poses."""

from __future__ import annotations

from collections.abc import Sequence

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.loading import kernels
from toolkit.depth.depth_priors import native, reference
from toolkit.depth.depth_priors.problem import (
    Image,
    NeighbourView,
    Planes,
    SweepOptions,
    SweptPlanes,
    check_images,
)


def plane_sweep(
    camera: Camera,
    intensity: Image,
    sources: Sequence[NeighbourView],
    planes: Planes,
    options: SweepOptions | None = None,
) -> SweptPlanes:
    """Find the plane on which an image agrees best with other images.

    Uses the compiled kernel, or the NumPy reference where there is none, which takes seconds.

    Args:
        camera: intrinsics of all images.
        intensity: [H, W] reference image in [0, 1].
        sources: other images, at least one.
        planes: inverse depths that are compared, at least two.

    Raises:
        ValueError: sizes disagree.
    """
    options = options or SweepOptions()
    check_images(camera, [intensity, planes.first, *(source.image for source in sources)])
    module = kernels()
    if module is None:
        return reference.plane_sweep(camera, intensity, sources, planes, options)
    return native.plane_sweep(module, camera, intensity, sources, planes, options)


def double_depth(half: Image, half_intensity: Image, intensity: Image, max_step: float) -> Image:
    """Interpolate inverse depth to an image of twice the size, without mixing surfaces.

    Args:
        half: [h, w] float32 inverse depth, 0 where unknown.
        half_intensity: [h, w] float32 in [0, 1].
        intensity: [H, W] float32 in [0, 1], with h = H // 2 and w = W // 2.
        max_step: difference of inverse depths on one surface.

    Returns:
        [H, W] float32: interpolated where the four pixels around are on one surface, else that of
        the pixel with the most similar intensity; 0 where all of them are unknown.
    """
    module = kernels()
    if module is None:
        return reference.double_depth(half, half_intensity, intensity, max_step)
    return native.double_depth(module, half, half_intensity, intensity, max_step)
