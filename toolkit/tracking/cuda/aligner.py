"""Launches the alignment's kernels, level by level, and reads the answer once at the end."""

from __future__ import annotations

import numpy as np
import torch
import triton
from numpy.typing import NDArray
from torch import Tensor

from toolkit.geometry import se3
from toolkit.rendering.cuda.backend import on
from toolkit.tracking import exposure
from toolkit.tracking.alignment import (
    LEAST_SCALES,
    MOST_SCALES,
    FrameLevel,
    Linearisation,
    ModelLevel,
    Scales,
)
from toolkit.tracking.cuda import accumulation, layout, stepping
from toolkit.tracking.gauss_newton import Alignment, Rules

_BLOCK, _WARPS = 64, 2  # pixels at once, by so many warps: more would not fit the registers
_PARTS = 512  # partial sums at most, so that their order does not depend on the GPU
_ADDED = 32  # partial sums read at once
_WIDE = int(layout.WIDE.value)
_PART = int(layout.PART.value)
_PHASE = int(layout.PHASE.value)
_SOLVABLE, _CONVERGED = 1.5, 1.0


def align(
    models: list[ModelLevel], frames: list[FrameLevel], start: Alignment, rules: Rules
) -> Alignment:
    """Gauss-Newton from coarse to fine; nothing is copied to the host before the end.

    Args:
        models, frames: levels from fine to coarse, on one device.
    """
    device = frames[0].depth_m.device
    weight = rules.photometric_weight
    state = _state_of(start, device)
    parts = torch.empty(_PARTS, _PART, device=device)
    last = torch.zeros(_WIDE, _WIDE, dtype=torch.float64, device=device)
    with on(device):
        for level in range(len(models) - 1, -1, -1):
            state[_PHASE].mul_(state[_PHASE] > _SOLVABLE)
            images = models[level], frames[level]
            cameras = _intrinsics(*images)
            gate = rules.max_distance * 2**level
            for _ in range(rules.iterations):
                count = _accumulate(*images, cameras, (state, parts), gate, weight)
                _advance((parts, state, last), count, rules, level)
    return _read(state, last)


def linearised(
    model: ModelLevel,
    frame: FrameLevel,
    T_model_frame: NDArray[np.float64],
    scales: Scales,
    gain_and_bias: tuple[float, float],
    max_distance: float,
) -> Linearisation:
    """See alignment.linearise."""
    device = frame.depth_m.device
    state = _state_of(Alignment(T_model_frame, scales, *gain_and_bias), device)
    parts = torch.empty(_PARTS, _PART, device=device)
    cameras = _intrinsics(model, frame)
    with on(device):
        weight = scales.photometric_weight
        count = _accumulate(model, frame, cameras, (state, parts), max_distance, weight)
    return _unpack(parts[:count].double().sum(0).view(_WIDE, _WIDE).cpu().numpy())


def _state_of(start: Alignment, device: torch.device) -> Tensor:
    numbers = np.zeros(layout.STATE)
    numbers[:12] = start.T_view_camera[:3].reshape(-1)
    numbers[12:16] = start.gain, start.bias, start.scales.intensity, start.scales.depth_m
    return torch.from_numpy(numbers).to(device)


def _intrinsics(model: ModelLevel, frame: FrameLevel) -> Tensor:
    """Intrinsics [8] as the kernel reads them: of the model view, then of the frame."""
    numbers = [n for c in (model.camera, frame.camera) for n in (c.fx, c.fy, c.cx, c.cy)]
    return torch.tensor(numbers, dtype=torch.float32, device=frame.depth_m.device)


def _accumulate(
    model: ModelLevel,
    frame: FrameLevel,
    cameras: Tensor,
    state_and_parts: tuple[Tensor, Tensor],
    gate: float,
    photometric_weight: float,
) -> int:
    """Launch the sums of one step; the number of partial results."""
    state, parts = state_and_parts
    width, height = frame.camera.size
    chunks = triton.cdiv(width * height, _BLOCK)
    count = min(chunks, _PARTS)
    accumulation.accumulate[(count,)](
        model.texture,
        model.surface,
        frame.intensity,
        frame.depth_m,
        cameras,
        state,
        parts,
        *model.camera.size,
        *frame.camera.size,
        gate,
        float(np.sqrt(photometric_weight)),
        chunks,
        BLOCK=_BLOCK,
        num_warps=_WARPS,
    )
    return count


def _advance(tensors: tuple[Tensor, Tensor, Tensor], count: int, rules: Rules, level: int) -> None:
    parts, state, last = tensors
    adjust = rules.exposure is not None and level == 0
    stepping.advance[(1,)](
        parts,
        state,
        last,
        count,
        *(rules.exposure or (1.0, 0.0)),
        rules.photometric_weight,
        exposure.PRIOR,
        rules.fewest_pixels,
        rules.small_m * 4**level,
        rules.small_rad * 4**level,
        LEAST_SCALES.intensity,
        MOST_SCALES.intensity,
        LEAST_SCALES.depth_m,
        MOST_SCALES.depth_m,
        ROWS=_ADDED,
        EXPOSURE=adjust,
        num_warps=8,
    )


def _read(state: Tensor, last: Tensor) -> Alignment:
    """The one copy to the host."""
    numbers = torch.cat([state, last.view(-1)]).cpu().numpy()
    T = np.eye(4)
    T[:3] = numbers[:12].reshape(3, 4)
    gain, bias, intensity, depth_m, steps, phase = (float(x) for x in numbers[12:18])
    return Alignment(
        se3.orthonormalise(T),
        Scales(intensity, depth_m),
        gain,
        bias,
        int(steps),
        phase == _CONVERGED,
        _unpack(numbers[layout.STATE :].reshape(_WIDE, _WIDE)) if steps else None,
    )


def _unpack(sums: NDArray[np.float64]) -> Linearisation:
    bright, flat, bright_square, flat_square, inside = (float(x) for x in sums[-1, :5])
    return Linearisation(
        H=sums[:8, :8].copy(),
        g=sums[:8, 8].copy(),
        intensity_pixels=bright,
        depth_pixels=flat,
        intensity_variance=bright_square / max(bright, 1.0),
        depth_variance=flat_square / max(flat, 1.0),
        frame_pixels=inside,
    )
