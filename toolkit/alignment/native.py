"""Alignment on the CPU with the C++ kernels."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.alignment.data import FrameLevel, Linearisation, ModelLevel, ResidualScales
from toolkit.alignment.gauss_newton import HostGaussNewton
from toolkit.exposure import Exposure
from toolkit.geometry.camera import Camera
from toolkit.native import address
from toolkit.native.constants import ALIGNMENT_SUMS


class NativeBackend(HostGaussNewton):
    """See AlignmentBackend.

    Args:
        module: compiled kernels, loaded by `toolkit.native`.
    """

    def __init__(self, module: ModuleType) -> None:
        self._module = module

    def intensity(self, images: Tensor, min_silhouette: float) -> Tensor:
        """See AlignmentBackend."""
        height, width = images.shape[-2:]
        intensity = torch.empty(height, width)
        self._module.align_intensity(
            (width, height), address(images), min_silhouette, address(intensity)
        )
        return intensity

    def halve(self, level: FrameLevel, max_difference: float) -> FrameLevel:
        """See AlignmentBackend."""
        camera = level.camera.halved()
        intensity, depth_m = (torch.empty(camera.height, camera.width) for _ in range(2))
        self._module.align_halve(
            level.camera.size,
            address(level.intensity),
            address(level.depth_m),
            max_difference,
            address(intensity),
            address(depth_m),
        )
        return FrameLevel(camera, intensity, depth_m)

    def model(self, level: FrameLevel) -> ModelLevel:
        """See AlignmentBackend."""
        camera = level.camera
        texture, surface = (torch.empty(camera.height, camera.width, 4) for _ in range(2))
        self._module.align_level(
            _intrinsics(camera),
            camera.size,
            address(level.intensity),
            address(level.depth_m),
            address(texture),
            address(surface),
        )
        return ModelLevel(camera, texture, surface)

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
        cameras = model.camera, frame.camera
        sigmas = scales.intensity, scales.depth_m
        sums = np.empty(ALIGNMENT_SUMS)
        self._module.align_accumulate(
            [_intrinsics(camera) for camera in cameras],
            [camera.size for camera in cameras],
            [address(t) for t in (model.texture, model.surface, frame.intensity, frame.depth_m)],
            np.asarray(T_model_frame[:3]).reshape(-1).tolist(),
            (exposure.gain, exposure.bias, *sigmas, max_distance, scales.photometric_weight),
            sums.ctypes.data,
        )
        return Linearisation.from_sums(sums)


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy
