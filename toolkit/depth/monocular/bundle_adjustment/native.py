"""Bundle adjustment with the C++ kernel."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.depth.monocular.bundle_adjustment.problem import (
    BundleOptions,
    BundleProblem,
    BundleResult,
)


def adjust(kernels: ModuleType, problem: BundleProblem, options: BundleOptions) -> BundleResult:
    """See `toolkit.depth.monocular.bundle_adjustment.solver.adjust`."""
    marks, seen, camera = problem.landmarks, problem.observations, problem.camera
    T_camera_world = np.ascontiguousarray(se3.inverse(problem.T_world_camera)[:, :3])
    inverse_depth = np.array(marks.inverse_depth, np.float64)
    error_px = np.zeros(len(seen))
    arrays: list[NDArray] = [
        T_camera_world,
        np.ascontiguousarray(problem.fixed, np.uint8),
        np.ascontiguousarray(marks.anchor, np.int32),
        np.ascontiguousarray(marks.anchor_px, np.float64),
        inverse_depth,
        np.ascontiguousarray(marks.prior, np.float64),
        np.ascontiguousarray(seen.landmark, np.int32),
        np.ascontiguousarray(seen.pose, np.int32),
        np.ascontiguousarray(seen.px, np.float64),
        error_px,
    ]
    cost_before, cost, focal_factor, information, iterations, converged = kernels.adjust_bundle(
        [array.ctypes.data for array in arrays],
        (len(problem.fixed), len(marks), len(seen)),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        options.iterations,
        (options.huber_px, options.min_inverse_depth, options.min_decrease),
        options.focal,
    )
    T = np.tile(np.eye(4), (len(T_camera_world), 1, 1))
    T[:, :3] = T_camera_world
    T_world_camera = se3.inverse(T)
    T_world_camera[problem.fixed] = problem.T_world_camera[problem.fixed]
    sigma = 0.0
    if options.focal:
        sigma = 1.0 / math.sqrt(information) if information > 0 else math.inf
    return BundleResult(
        T_world_camera,
        inverse_depth,
        error_px,
        cost_before,
        cost,
        focal_factor,
        sigma,
        iterations,
        converged,
    )
