"""Joint alignment: one rigid motion from many pairs of views, by dense Gauss-Newton.

The normal equations of all pairs that share `T_target_source` are summed. Each pair has its own
exposure, which is eliminated before the sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.splatting.alignment.backend import linearise
from toolkit.splatting.alignment.data import (
    INITIAL_SCALES,
    FrameLevel,
    LevelProblem,
    Linearisation,
    ModelLevel,
    ResidualScales,
    rescaled,
)
from toolkit.splatting.alignment.gauss_newton import (
    add_exposure_prior,
    coarse_to_fine,
    damped_step,
    fix_exposure,
    is_small,
)

Array = NDArray[np.float64]

# Minimum number of residuals.
MIN_PIXELS = 50
# Maximum depth difference of corresponding pixels at the finest level, as a fraction of depth. It
# doubles with every coarser level.
MAX_DISTANCE = 0.05
# Maximum step of an iteration.
_MAX_TRANSLATION_M, _MAX_ROTATION_RAD = 0.2, 0.2
# A smaller change of gain and bias ends the finest level.
_MIN_EXPOSURE_STEP = 0.004


@dataclass(frozen=True)
class JointOptions:
    """Parameters of a joint alignment.

    Attributes:
        levels: number of pyramid levels of the first pass.
        iterations: maximum number of iterations per pyramid level.
        exposure: estimate the exposure (gain and bias) of each pair at the finest level.
        geometric_weight: weight of the geometric term relative to the photometric term at the
            finest level.
        small_translation_m, small_rotation_rad: smaller steps end the finest level.
    """

    levels: int = 4
    iterations: int = 12
    exposure: bool = True
    geometric_weight: float = 1.0
    small_translation_m: float = 1e-4
    small_rotation_rad: float = 5e-5


@dataclass(frozen=True)
class Pair:
    """Two views of the same surfaces, one of the target and one of the source.

    Attributes:
        model: levels of the target's view, from fine to coarse.
        frame: levels of the source's view, from fine to coarse.
        T_model_target: [4, 4] target to camera of the model view.
        T_source_frame: [4, 4] pose of the source view's camera.
    """

    model: list[ModelLevel]
    frame: list[FrameLevel]
    T_model_target: Array
    T_source_frame: Array


@dataclass(frozen=True)
class Estimate:
    """The estimate of a joint alignment.

    Attributes:
        T_target_source: [4, 4].
        scales: of the residuals of all pairs.
        exposures: [K, 2] gain and bias of each pair.
        information: [6, 6] of x in T_target_source exp(x).
        pixels: [K] number of depth residuals of each pair.
        iterations: number of iterations so far.
        converged: whether the last step was small.
    """

    T_target_source: Array
    scales: ResidualScales = INITIAL_SCALES
    exposures: Array = field(default_factory=lambda: np.zeros((0, 2)))
    information: Array = field(default_factory=lambda: np.zeros((6, 6)))
    pixels: Array = field(default_factory=lambda: np.zeros(0))
    iterations: int = 0
    converged: bool = False


def align(
    pairs: Sequence[Pair], start: Estimate, options: JointOptions, finest_only: bool = False
) -> Estimate:
    """Estimate T_target_source from all pairs, from coarse to fine.

    Args:
        finest_only: skip the coarse levels, for pairs rendered close to the solution.
    """
    estimate = start
    if len(start.exposures) != len(pairs):
        estimate = replace(start, exposures=np.tile([1.0, 0.0], (len(pairs), 1)))
    levels = 1 if finest_only else min(options.levels, len(pairs[0].model))

    def step(level: int, estimate: Estimate) -> tuple[Estimate, bool]:
        return _stepped(pairs, level, estimate, options)

    return coarse_to_fine(levels, options.iterations, estimate, step)


def _stepped(
    pairs: Sequence[Pair], level: int, estimate: Estimate, options: JointOptions
) -> tuple[Estimate, bool]:
    """One Gauss-Newton iteration, and whether the equations could be solved."""
    linears = linearised(pairs, level, estimate, options)
    with_exposure = options.exposure and level == 0
    parts = [
        Eliminated.of(pair, linear, estimate, with_exposure)
        for pair, linear in zip(pairs, linears, strict=True)
    ]
    H = np.sum([part.H for part in parts], axis=0)
    g = np.sum([part.g for part in parts], axis=0)
    pixels = np.array([linear.depth_pixels for linear in linears])
    estimate = replace(estimate, information=H, pixels=pixels, iterations=estimate.iterations + 1)
    step = damped_step(H, g)
    if step is None or sum(n.depth_pixels + n.intensity_pixels for n in linears) < MIN_PIXELS:
        return replace(estimate, converged=False), False
    step = _limited(step)
    small = is_small(step, options.small_translation_m, options.small_rotation_rad, level)
    exposure_steps = np.array([part.exposure_step(step) for part in parts])
    small &= bool(np.abs(exposure_steps).max() < _MIN_EXPOSURE_STEP)
    return replace(
        estimate,
        T_target_source=se3.orthonormalise(estimate.T_target_source @ se3.exp(step)),
        scales=_rescaled(estimate.scales, linears),
        exposures=estimate.exposures + exposure_steps,
        converged=small,
    ), True


def linearised(
    pairs: Sequence[Pair],
    level: int,
    estimate: Estimate,
    options: JointOptions,
    photometric: bool = True,
) -> list[Linearisation]:
    """The normal equations of each pair at one level.

    Only the finest level weights the geometric term: the coarser ones need it for convergence.

    Args:
        photometric: include the photometric term.
    """
    gate = MAX_DISTANCE * 2**level
    weight = options.geometric_weight if level == 0 else 1.0
    # The kernels weight the photometric term instead.
    scales = replace(estimate.scales, photometric_weight=1.0 / weight if photometric else 0.0)
    linears = [
        linearise(
            LevelProblem(
                pair.model[level],
                pair.frame[level],
                pair.T_model_target @ estimate.T_target_source @ pair.T_source_frame,
                scales,
                Exposure(*(float(value) for value in estimate.exposures[k])),
                gate,
            )
        )
        for k, pair in enumerate(pairs)
    ]
    return [replace(linear, H=weight * linear.H, g=weight * linear.g) for linear in linears]


@dataclass(frozen=True)
class Eliminated:
    """Normal equations of a pair in x of T_target_source exp(x), with its exposure eliminated.

    T_model_frame = T_model_target T T_source_frame, so x on the right of T is
    Ad(T_model_target T) x on the left of T_model_frame, where `linearise` perturbs.
    """

    H: Array
    g: Array
    by_exposure: Array  # [2, 6]: the exposure's step is constant - by_exposure @ x
    constant: Array  # [2]
    adjoint: Array  # [6, 6]: from x to the tangent of `linearise`

    @classmethod
    def of(
        cls, pair: Pair, linear: Linearisation, estimate: Estimate, with_exposure: bool
    ) -> Eliminated:
        A = se3.adjoint(pair.T_model_target @ estimate.T_target_source)
        H, g = linear.H.copy(), linear.g.copy()
        if with_exposure and linear.intensity_pixels > 0:
            information = linear.intensity_pixels / estimate.scales.intensity**2
            # The exposures of two maps may differ by any amount: the prior applies to the step.
            add_exposure_prior(H, g, information, np.zeros(2))
        else:
            fix_exposure(H, g)
        cross = H[6:, :6] @ A
        solved: Array = np.asarray(
            np.linalg.solve(H[6:, 6:], np.column_stack([cross, g[6:]])), float
        )
        by_exposure, constant = solved[:, :6], -solved[:, 6]
        return cls(
            H=A.T @ H[:6, :6] @ A - cross.T @ by_exposure,
            g=A.T @ g[:6] + cross.T @ constant,
            by_exposure=by_exposure,
            constant=constant,
            adjoint=A,
        )

    def gradient(self, g: Array) -> Array:
        """Gradient [6] in x of some of the pair's residuals, from their gradient g [8]."""
        return np.asarray(self.adjoint.T @ g[:6] - self.by_exposure.T @ g[6:])

    def exposure_step(self, x: Array) -> Array:
        """Change [2] of gain and bias for a step x."""
        return self.constant - self.by_exposure @ x


def _limited(step: Array) -> Array:
    """The step, scaled down if its translation or its rotation is too large."""
    excess = max(
        float(np.linalg.norm(step[:3])) / _MAX_TRANSLATION_M,
        float(np.linalg.norm(step[3:])) / _MAX_ROTATION_RAD,
        1.0,
    )
    return step / excess


def _rescaled(scales: ResidualScales, linears: Sequence[Linearisation]) -> ResidualScales:
    """Re-estimate the scales from the residuals of all pairs."""
    intensities = np.array([n.intensity_pixels for n in linears])
    depths = np.array([n.depth_pixels for n in linears])
    intensity_squares = intensities @ [n.intensity_variance for n in linears]
    depth_squares = depths @ [n.depth_variance for n in linears]
    combined = replace(
        linears[0],
        intensity_pixels=float(intensities.sum()),
        depth_pixels=float(depths.sum()),
        intensity_variance=float(intensity_squares / max(intensities.sum(), 1.0)),
        depth_variance=float(depth_squares / max(depths.sum(), 1.0)),
    )
    return rescaled(scales, combined)
