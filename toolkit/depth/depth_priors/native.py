"""Plane sweeps with the C++ kernels."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import numpy as np

from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.problem import (
    Consensus,
    Image,
    NeighbourView,
    Planes,
    SweepOptions,
    SweptPlanes,
)


def plane_sweep(
    kernels: ModuleType,
    camera: Camera,
    intensity: Image,
    sources: Sequence[NeighbourView],
    planes: Planes,
    options: SweepOptions,
) -> SweptPlanes:
    """See `toolkit.depth.depth_priors.plane_sweep.plane_sweep`."""
    found = SweptPlanes(*(np.empty(intensity.shape, np.float32) for _ in range(3)))
    kernels.plane_sweep(
        _intrinsics(camera),
        camera.size,
        intensity.ctypes.data,
        _posed(sources),
        (planes.first.ctypes.data, planes.count),
        (planes.step, options.step_penalty, options.jump_penalty),
        [image.ctypes.data for image in (found.plane, found.correlation, found.margin)],
    )
    return found


def double_depth(
    kernels: ModuleType, half: Image, half_intensity: Image, intensity: Image, max_step: float
) -> Image:
    """See `toolkit.depth.depth_priors.plane_sweep.double_depth`."""
    doubled = np.empty(intensity.shape, np.float32)
    kernels.double_depth(
        (half.shape[::-1], half_intensity.ctypes.data, half.ctypes.data),
        intensity.shape[::-1],
        (intensity.ctypes.data, doubled.ctypes.data),
        max_step,
    )
    return doubled


def remove_fattening(
    kernels: ModuleType, intensity: Image, inverse_depth: Image, behind: Image
) -> Image:
    """See `toolkit.depth.depth_priors.coarse_to_fine.remove_fattening`."""
    kept = np.empty_like(inverse_depth)
    images = (intensity, inverse_depth, behind, kept)
    kernels.remove_fattening(inverse_depth.shape[::-1], [image.ctypes.data for image in images])
    return kept


def find_consensus(
    kernels: ModuleType,
    camera: Camera,
    inverse_depth: Image,
    others: Sequence[NeighbourView],
    limits: tuple[float, float],
) -> Consensus:
    """See `toolkit.depth.depth_priors.consensus.find_consensus`."""
    images = [np.empty(inverse_depth.shape, np.float32) for _ in range(5)]
    kernels.find_consensus(
        _intrinsics(camera),
        camera.size,
        inverse_depth.ctypes.data,
        _posed(others),
        limits,
        [image.ctypes.data for image in images],
    )
    return Consensus(*images)


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy


def _posed(images: Sequence[NeighbourView]) -> list[tuple[int, list[float]]]:
    return [
        (i.image.ctypes.data, np.asarray(i.T_other_reference[:3], np.float64).ravel().tolist())
        for i in images
    ]
