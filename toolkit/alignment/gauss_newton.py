"""Gauss-Newton from coarse to fine: pose and exposure of a frame against a view.

The reference of `src/alignment/gauss_newton.cpp`. On a GPU, all steps are launched before the host
reads a result, see `cuda/aligner`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import (
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    Linearisation,
    ModelLevel,
    ResidualScales,
    rescaled,
)
from toolkit.alignment.normal_equations import (
    BIAS,
    GAIN,
    add_exposure_prior,
    damped_step,
    fix_exposure,
)
from toolkit.exposure import Exposure
from toolkit.geometry import se3


class HostGaussNewton(ABC):
    """Gauss-Newton for backends whose normal equations are in the host's memory."""

    @abstractmethod
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

    def align(
        self,
        models: list[ModelLevel],
        frames: list[FrameLevel],
        start: Alignment,
        options: GaussNewtonOptions,
    ) -> Alignment:
        """See AlignmentBackend."""
        estimate = start
        for level in range(len(models) - 1, -1, -1):
            estimate = replace(estimate, converged=False)
            for _ in range(options.iterations):
                linear = self._linearised(models[level], frames[level], estimate, options, level)
                estimate = replace(estimate, last=linear, iterations=estimate.iterations + 1)
                step = _solved(linear, estimate, options, adjust_exposure=level == 0)
                if step is None:
                    return replace(estimate, converged=False)
                estimate = _moved(estimate, step, converged=_is_small(step, options, level))
                if estimate.converged:
                    break
        return estimate

    def _linearised(
        self,
        model: ModelLevel,
        frame: FrameLevel,
        estimate: Alignment,
        options: GaussNewtonOptions,
        level: int,
    ) -> Linearisation:
        scales = replace(estimate.scales, photometric_weight=options.photometric_weight)
        max_distance, T = options.max_distance * 2**level, estimate.T_view_camera
        return self.linearise(model, frame, T, scales, estimate.exposure, max_distance)


def _moved(estimate: Alignment, step: NDArray[np.float64], converged: bool) -> Alignment:
    """The estimate after a step [8], with re-estimated scales."""
    assert estimate.last is not None
    exposure = estimate.exposure
    return replace(
        estimate,
        T_view_camera=se3.orthonormalise(se3.exp(step[:6]) @ estimate.T_view_camera),
        exposure=Exposure(exposure.gain + float(step[GAIN]), exposure.bias + float(step[BIAS])),
        scales=rescaled(estimate.scales, estimate.last),
        converged=converged,
    )


def _is_small(step: NDArray[np.float64], options: GaussNewtonOptions, level: int) -> bool:
    """Whether a step [8] ends a level. Pixels of coarser levels are larger, and so are steps."""
    translation, rotation = np.linalg.norm(step[:3]), np.linalg.norm(step[3:6])
    small = translation < options.min_translation_m * 4**level
    return bool(small and rotation < options.min_rotation_rad * 4**level)


def _solved(
    linear: Linearisation, estimate: Alignment, options: GaussNewtonOptions, adjust_exposure: bool
) -> NDArray[np.float64] | None:
    """The step [8], or None if the equations cannot be solved."""
    if linear.depth_pixels + linear.intensity_pixels < options.min_pixels:
        return None
    H, g = linear.H.copy(), linear.g.copy()
    if options.exposure is None or not adjust_exposure:
        fix_exposure(H, g)
    else:
        pixels = linear.intensity_pixels / estimate.scales.intensity**2
        current, previous = estimate.exposure, options.exposure
        change = np.array([current.gain - previous.gain, current.bias - previous.bias])
        add_exposure_prior(H, g, options.photometric_weight * pixels, change)
    return damped_step(H, g)
