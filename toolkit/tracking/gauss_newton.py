"""Gauss-Newton from coarse to fine: a frame moved onto a rendered view, with its exposure.

On the CPU step by step; on a GPU all steps are launched before the host reads anything
(`tracking/cuda/aligner.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.tracking import exposure
from toolkit.tracking.alignment import (
    FrameLevel,
    Linearisation,
    ModelLevel,
    Scales,
    linearise,
    rescaled,
)


@dataclass(frozen=True)
class Rules:
    """How an alignment goes on.

    Attributes:
        iterations: most steps a level.
        max_distance: gate on depth differences at the finest level; doubled at each coarser one.
        photometric_weight: of the photometric term against the geometric one.
        exposure: gain and bias of the last frame, or None to leave exposure alone. Only the
            finest level adjusts it: a coarse view may be far off, and fits the pose at the
            last exposure.
        fewest_pixels: residuals that fix a pose.
        small_m, small_rad: steps below these end the finest level; four times as much does at
            each coarser one.
    """

    iterations: int
    max_distance: float
    photometric_weight: float
    exposure: tuple[float, float] | None
    fewest_pixels: int
    small_m: float
    small_rad: float


@dataclass(frozen=True)
class Alignment:
    """The state of one frame's alignment against one view.

    Attributes:
        T_view_camera: [4, 4]. scales: of the residuals. gain, bias: of the frame.
        iterations: taken. converged: at the finest level.
        last: the normal equations of the last step, or None before the first.
    """

    T_view_camera: NDArray[np.float64]
    scales: Scales
    gain: float
    bias: float
    iterations: int = 0
    converged: bool = False
    last: Linearisation | None = None


def align(
    models: list[ModelLevel], frames: list[FrameLevel], start: Alignment, rules: Rules
) -> Alignment:
    """Move a frame onto a view.

    It ends at once, not converged, where too few pixels are left or the equations are singular.

    Args:
        models, frames: levels from fine to coarse, on one device.
    """
    if frames[0].depth_m.is_cuda:
        from toolkit.tracking.cuda import aligner

        found = aligner.align(models, frames, start, rules)
        iterations = start.iterations + found.iterations
        return replace(found, iterations=iterations, last=found.last or start.last)
    found = start
    for level in range(len(models) - 1, -1, -1):
        found = replace(found, converged=False)
        for _ in range(rules.iterations):
            stepped, small = _stepped(models[level], frames[level], found, rules, level)
            found = replace(stepped, iterations=found.iterations + 1, converged=bool(small))
            if small is None:
                return found
            if small:
                break
    return found


def _stepped(
    model: ModelLevel, frame: FrameLevel, state: Alignment, rules: Rules, level: int
) -> tuple[Alignment, bool | None]:
    """One step, and whether it was small; None where the equations cannot be solved."""
    gate = rules.max_distance * 2**level
    scales = replace(state.scales, photometric_weight=rules.photometric_weight)
    tones = (state.gain, state.bias)
    linear = linearise(model, frame, state.T_view_camera, scales, tones, gate)
    state = replace(state, last=linear)
    step = _solved(linear, state, rules, adjusts_exposure=level == 0)
    if step is None:
        return state, None
    moved = replace(
        state,
        T_view_camera=se3.orthonormalise(se3.exp(step[:6]) @ state.T_view_camera),
        gain=state.gain + float(step[6]),
        bias=state.bias + float(step[7]),
        scales=rescaled(state.scales, linear),
    )
    small = np.linalg.norm(step[:3]) < rules.small_m * 4**level
    return moved, bool(small and np.linalg.norm(step[3:6]) < rules.small_rad * 4**level)


def _solved(
    linear: Linearisation, state: Alignment, rules: Rules, adjusts_exposure: bool
) -> NDArray[np.float64] | None:
    """The step [8], or None."""
    if linear.depth_pixels + linear.intensity_pixels < rules.fewest_pixels:
        return None
    H, g = linear.H.copy(), linear.g.copy()
    if rules.exposure is None or not adjusts_exposure:
        exposure.fix(H, g)
    else:
        pixels = linear.intensity_pixels / state.scales.intensity**2
        change = np.array([state.gain, state.bias]) - rules.exposure
        exposure.hold(H, g, rules.photometric_weight * pixels, change)
    return damped_step(H, g)


def damped_step(H: NDArray[np.float64], g: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The step [n] that solves H x = -g, or None where the equations are singular."""
    damped = H.copy()
    damped[np.diag_indices(len(g))] *= 1.0 + 1e-6
    try:
        step = np.asarray(-np.linalg.solve(damped, g), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    return step if np.isfinite(step).all() else None
