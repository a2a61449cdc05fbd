"""Backends of alignment, selected by the device of the images.

Images on the CPU are processed by the C++ kernels, or by NumPy if these are not compiled; images on
a GPU by torch and Triton. The backends are tested against each other.
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from toolkit.base.native import kernels_for
from toolkit.splatting.alignment.data import (
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    LevelProblem,
    Linearisation,
    ModelLevel,
)


class AlignmentBackend(Protocol):
    """Computes pyramids, models and normal equations of images on a type of device."""

    def intensity(self, images: Tensor, min_silhouette: float) -> Tensor:
        """Intensity [H, W] of a rendering [5, H, W], 0 where its silhouette is below a minimum.

        The intensity is not divided by the silhouette: mapping fits colours as composited, and
        the difference would cause an exposure that grows with every keyframe.
        """
        ...

    def halve(self, level: FrameLevel, max_difference: float) -> FrameLevel:
        """The next level: intensity and depth of the nearest surface in each 2x2 cell.

        Args:
            max_difference: depth differences beyond this fraction of the depth belong to another
                surface.
        """
        ...

    def model(self, level: FrameLevel) -> ModelLevel:
        """Derivatives of the intensity and planes of the depth of one level."""
        ...

    def linearise(self, problem: LevelProblem) -> Linearisation:
        """See `linearise`."""
        ...

    def align(
        self,
        models: list[ModelLevel],
        frames: list[FrameLevel],
        start: Alignment,
        options: GaussNewtonOptions,
    ) -> Alignment:
        """See `align`."""
        ...


def backend_for(tensor: Tensor) -> AlignmentBackend:
    """The backend for images on a tensor's device."""
    if tensor.device.type != "cpu":
        from toolkit.splatting.alignment.cuda.backend import CudaAlignment

        return CudaAlignment()
    module = kernels_for(tensor)
    if module is None:
        from toolkit.splatting.alignment.reference import NumpyBackend

        return NumpyBackend()
    from toolkit.splatting.alignment.native import NativeAlignment

    return NativeAlignment(module)


def linearise(problem: LevelProblem) -> Linearisation:
    """Normal equations of a problem at its pose. The tangent multiplies from the left."""
    return backend_for(problem.frame.depth_m).linearise(problem)


def align(
    models: list[ModelLevel],
    frames: list[FrameLevel],
    start: Alignment,
    options: GaussNewtonOptions,
) -> Alignment:
    """Align a frame to a view by Gauss-Newton, from coarse to fine.

    The estimate returned is not converged if too few pixels are left or the equations are
    singular.

    Args:
        models, frames: levels from fine to coarse, on one device.
    """
    return backend_for(frames[0].depth_m).align(models, frames, start, options)
