"""Alignment on the CPU with the C++ kernels."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
from torch import Tensor

from toolkit.base.exposure import Exposure
from toolkit.base.geometry.camera import Camera
from toolkit.base.native import address
from toolkit.base.native.constants import ALIGNMENT_SUMS
from toolkit.splatting.alignment.data import (
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    LevelProblem,
    Linearisation,
    ModelLevel,
)


class NativeAlignment:
    """See AlignmentBackend.

    Args:
        module: compiled kernels, loaded by `toolkit.base.native`.
    """

    def __init__(self, module: ModuleType) -> None:
        self._module = module

    def intensity(self, images: Tensor, min_silhouette: float) -> Tensor:
        """See AlignmentBackend."""
        height, width = images.shape[-2:]
        intensity = images.new_empty(height, width)
        self._module.align_intensity(
            (width, height), address(images), min_silhouette, address(intensity)
        )
        return intensity

    def halve(self, level: FrameLevel, max_difference: float) -> FrameLevel:
        """See AlignmentBackend."""
        camera = level.camera.halved()
        intensity, depth_m = (level.depth_m.new_empty(camera.size[::-1]) for _ in range(2))
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
        texture, surface = (level.depth_m.new_empty(*camera.size[::-1], 4) for _ in range(2))
        self._module.align_level(
            _intrinsics(camera),
            camera.size,
            address(level.intensity),
            address(level.depth_m),
            address(texture),
            address(surface),
        )
        return ModelLevel(camera, texture, surface)

    def linearise(self, problem: LevelProblem) -> Linearisation:
        """See AlignmentBackend."""
        sums = np.empty(ALIGNMENT_SUMS)
        self._module.align_accumulate(
            _level(problem.model, problem.frame),
            np.asarray(problem.T_model_frame[:3]).reshape(-1).tolist(),
            problem.parameters,
            sums.ctypes.data,
        )
        return Linearisation.from_sums(sums)

    def align(
        self,
        models: list[ModelLevel],
        frames: list[FrameLevel],
        start: Alignment,
        options: GaussNewtonOptions,
    ) -> Alignment:
        """See AlignmentBackend."""
        exposure, scales, prior = start.exposure, start.scales, options.exposure
        sums = np.empty(ALIGNMENT_SUMS)
        pose, (gain, bias, intensity, depth_m), iterations, converged = self._module.align_pose(
            [_level(*level) for level in zip(models, frames, strict=True)],
            start.T_view_camera[:3].reshape(-1).tolist(),
            (exposure.gain, exposure.bias, scales.intensity, scales.depth_m),
            (options.iterations, options.min_pixels),
            (
                options.max_distance,
                options.photometric_weight,
                options.min_translation_m,
                options.min_rotation_rad,
            ),
            None if prior is None else (prior.gain, prior.bias),
            sums.ctypes.data,
        )
        T_view_camera = np.eye(4)
        T_view_camera[:3] = np.reshape(pose, (3, 4))
        return Alignment(
            T_view_camera=T_view_camera,
            scales=replace(scales, intensity=intensity, depth_m=depth_m),
            exposure=Exposure(gain, bias),
            iterations=start.iterations + iterations,
            converged=converged,
            last=Linearisation.from_sums(sums) if iterations else start.last,
        )


def _level(model: ModelLevel, frame: FrameLevel) -> tuple[list, list, list]:
    """Intrinsics, sizes and addresses of a level, as the kernels expect them."""
    cameras = model.camera, frame.camera
    images = model.texture, model.surface, frame.intensity, frame.depth_m
    return (
        [_intrinsics(camera) for camera in cameras],
        [camera.size for camera in cameras],
        [address(image) for image in images],
    )


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy
