"""Alignment on a GPU. Triton is loaded only when a frame is linearised or aligned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from toolkit.alignment.cuda import images as torch_images
from toolkit.alignment.data import (
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    Linearisation,
    ModelLevel,
    ResidualScales,
)
from toolkit.exposure import Exposure


class CudaAlignment:
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

    def linearise(
        self,
        model: ModelLevel,
        frame: FrameLevel,
        T_model_frame: NDArray[np.float64],
        scales: ResidualScales,
        exposure: Exposure,
        max_distance: float,
    ) -> Linearisation:
        """See AlignmentBackend."""
        from toolkit.alignment.cuda import aligner

        return aligner.linearise(model, frame, T_model_frame, scales, exposure, max_distance)

    def align(
        self,
        models: list[ModelLevel],
        frames: list[FrameLevel],
        start: Alignment,
        options: GaussNewtonOptions,
    ) -> Alignment:
        """See AlignmentBackend."""
        from toolkit.alignment.cuda import aligner

        found = aligner.align(models, frames, start, options)
        iterations = start.iterations + found.iterations
        return replace(found, iterations=iterations, last=found.last or start.last)
