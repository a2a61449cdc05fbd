"""Gauss-Newton from coarse to fine: pose and exposure of a frame against a view.

The loop of all alignments: backends compute normal equations. On a CPU with the C++ kernels,
`src/alignment/gauss_newton.cpp` runs it for a single frame, because Python between the iterations
takes 4 ms of 36 ms per frame (RedKitchen, 320x240); this module is its reference.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.base.native.constants import EXPOSURE_PRIOR, SOLVER_DAMPING
from toolkit.splatting.alignment.data import (
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    LevelProblem,
    Linearisation,
    ModelLevel,
    rescaled,
)

# Indices of gain and bias; model intensity = gain * frame intensity + bias.
GAIN, BIAS = 6, 7
Estimate = TypeVar("Estimate", bound="IterativeEstimate")


def add_exposure_prior(
    H: NDArray[np.float64], g: NDArray[np.float64], information: float, change: NDArray[np.float64]
) -> None:
    """Add a prior on the change of exposure since the previous frame to H [8, 8] and g [8].

    Exposure changes little between frames. Without the prior, a gain of 0 would minimise the
    residuals of any misalignment: on motions of 5 to 17 degrees it moved the pose by 70 cm.

    Args:
        information: information of all pixels about the bias, number of pixels / variance.
        change: [2] change of gain and bias since the previous frame.
    """
    prior = EXPOSURE_PRIOR * information
    for index, difference in zip((GAIN, BIAS), change, strict=True):
        H[index, index] += prior
        g[index] += prior * difference


def fix_exposure(H: NDArray[np.float64], g: NDArray[np.float64]) -> None:
    """Remove gain and bias from H [8, 8] and g [8], in place: their step is 0."""
    H[GAIN:, :] = 0.0
    H[:, GAIN:] = 0.0
    H[GAIN, GAIN] = H[BIAS, BIAS] = 1.0
    g[GAIN:] = 0.0


def damped_step(H: NDArray[np.float64], g: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The step [n] that solves H x = -g with slight damping, or None if H is singular."""
    damped = H.copy()
    damped[np.diag_indices(len(g))] *= 1.0 + SOLVER_DAMPING
    try:
        step = np.asarray(-np.linalg.solve(damped, g), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    return step if np.isfinite(step).all() else None


class IterativeEstimate(Protocol):
    """An estimate that is refined iteration by iteration."""

    @property
    def converged(self) -> bool:
        """Whether the last step was small."""
        ...


def coarse_to_fine(
    levels: int,
    iterations: int,
    estimate: Estimate,
    step: Callable[[int, Estimate], tuple[Estimate, bool]],
) -> Estimate:
    """Refine an estimate from the coarsest level to the finest.

    Args:
        levels: number of levels.
        iterations: maximum number of iterations per level; a converged estimate ends the level.
        step: one iteration at a level, and whether the equations could be solved; if they could
            not, its estimate is the result.
    """
    for level in range(levels - 1, -1, -1):
        for _ in range(iterations):
            estimate, solved = step(level, estimate)
            if not solved:
                return estimate
            if estimate.converged:
                break
    return estimate


class GaussNewton(ABC):
    """Alignment of one frame by backends that compute normal equations."""

    @abstractmethod
    def linearise(self, problem: LevelProblem) -> Linearisation:
        """See AlignmentBackend."""

    def align(
        self,
        models: list[ModelLevel],
        frames: list[FrameLevel],
        start: Alignment,
        options: GaussNewtonOptions,
    ) -> Alignment:
        """See AlignmentBackend."""

        def step(level: int, estimate: Alignment) -> tuple[Alignment, bool]:
            scales = replace(estimate.scales, photometric_weight=options.photometric_weight)
            problem = LevelProblem(
                models[level],
                frames[level],
                estimate.T_view_camera,
                scales,
                estimate.exposure,
                options.max_distance * 2**level,
            )
            linear = self.linearise(problem)
            estimate = replace(
                estimate, last=linear, iterations=estimate.iterations + 1, converged=False
            )
            found = _solved(linear, estimate, options, adjust_exposure=level == 0)
            if found is None:
                return estimate, False
            small = is_small(found, options.min_translation_m, options.min_rotation_rad, level)
            return _moved(estimate, found, small), True

        return coarse_to_fine(len(models), options.iterations, start, step)


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


def is_small(
    step: NDArray[np.float64], translation_m: float, rotation_rad: float, level: int
) -> bool:
    """Whether a step ends a level. Pixels of coarser levels are larger, and so are steps.

    Args:
        step: translation and rotation, then any other parameters.
        translation_m, rotation_rad: limits at the finest level.
    """
    translation, rotation = np.linalg.norm(step[:3]), np.linalg.norm(step[3:6])
    return bool(translation < translation_m * 4**level and rotation < rotation_rad * 4**level)


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
