"""Dense depth of an image from other images at known poses, with the C++ kernel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.camera import Camera
from toolkit.native.loading import require_kernels


@dataclass(frozen=True)
class SweepOptions:
    """Semi-global matching over planes of constant inverse depth.

    Attributes:
        step_penalty, jump_penalty: of neighbouring pixels on neighbouring planes, and on planes
            farther apart, relative to the highest matching cost.
    """

    step_penalty: float = 0.04
    jump_penalty: float = 0.4


@dataclass(frozen=True)
class SweptDepth:
    """Result of a plane sweep.

    Attributes:
        inverse_depth: [H, W] float32 inverse z-depth, 0 where unknown.
        correlation: [H, W] float32 in [0, 1], of the images at the chosen plane.
        margin: [H, W] float32 in [0, 1], by which the chosen plane fits better than any other.
    """

    inverse_depth: NDArray[np.float32]
    correlation: NDArray[np.float32]
    margin: NDArray[np.float32]


def plane_sweep(
    camera: Camera,
    intensity: NDArray[np.float32],
    sources: Sequence[tuple[NDArray[np.float32], NDArray[np.float64]]],
    inverse_depths: tuple[float, float],
    planes: int,
    options: SweepOptions | None = None,
) -> SweptDepth:
    """Find the depth at which an image agrees best with the images around it.

    Args:
        camera: intrinsics of all images.
        intensity: [H, W] reference image in [0, 1].
        sources: other images [H, W] and T_source_reference [4, 4], at least one.
        inverse_depths: of the farthest and the nearest plane.
        planes: their number.

    Raises:
        ValueError: sizes disagree or there is no source.
        DependencyError: the kernels have not been compiled.
    """
    options = options or SweepOptions()
    shape = (camera.height, camera.width)
    for image in (intensity, *(image for image, _ in sources)):
        if image.shape != shape or image.dtype != np.float32 or not image.flags.c_contiguous:
            raise ValueError(
                f"images must be contiguous float32 of shape {list(shape)}, "
                f"got {image.dtype} {list(image.shape)}"
            )
    far, near = inverse_depths
    if not sources or planes < 2 or not 0 <= far < near:
        raise ValueError("a sweep needs a source, two planes, and 0 <= far < near")
    module = require_kernels()
    result = SweptDepth(*(np.empty(shape, np.float32) for _ in range(3)))
    module.plane_sweep(
        (camera.fx, camera.fy, camera.cx, camera.cy),
        camera.size,
        intensity.ctypes.data,
        [(image.ctypes.data, np.asarray(T[:3]).reshape(-1).tolist()) for image, T in sources],
        planes,
        (far, near, options.step_penalty, options.jump_penalty),
        [a.ctypes.data for a in (result.inverse_depth, result.correlation, result.margin)],
    )
    return result
