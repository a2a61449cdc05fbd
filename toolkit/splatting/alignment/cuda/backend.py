"""Alignment on a GPU. Triton is loaded only when a frame is linearised or aligned."""

from __future__ import annotations

from torch import Tensor

from toolkit.splatting.alignment.cuda import images as torch_images
from toolkit.splatting.alignment.data import FrameLevel, LevelProblem, Linearisation, ModelLevel
from toolkit.splatting.alignment.gauss_newton import GaussNewton


class CudaAlignment(GaussNewton):
    """See AlignmentBackend."""

    def intensity(self, images: Tensor, min_silhouette: float) -> Tensor:
        """See AlignmentBackend."""
        return torch_images.intensity_of(images, min_silhouette)

    def halve(self, level: FrameLevel, max_difference: float) -> FrameLevel:
        """See AlignmentBackend."""
        images = torch_images.halve(level.intensity, level.depth_m, max_difference)
        return FrameLevel(level.camera.halved(), *images)

    def model(self, level: FrameLevel) -> ModelLevel:
        """See AlignmentBackend."""
        images = torch_images.model(level.camera, level.intensity, level.depth_m)
        return ModelLevel(level.camera, *images)

    def linearise(self, problem: LevelProblem) -> Linearisation:
        """See AlignmentBackend."""
        from toolkit.splatting.alignment.cuda.sums import linearise

        return linearise(problem)
