"""Launches the Triton kernels of alignment, level by level, and reads the result at the end."""

from __future__ import annotations

import numpy as np
import torch
import triton
from numpy.typing import NDArray
from torch import Tensor

from toolkit.alignment.cuda import accumulation, layout, stepping
from toolkit.alignment.data import (
    MAX_SCALES,
    MIN_SCALES,
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    Linearisation,
    ModelLevel,
    ResidualScales,
)
from toolkit.exposure import IDENTITY, Exposure
from toolkit.geometry import se3
from toolkit.native.constants import EXPOSURE_PRIOR
from toolkit.rendering.cuda.backend import on

_BLOCK, _WARPS = 64, 2  # pixels per block and warps; more pixels would not fit the registers
_PARTS = 512  # maximum number of partial sums; fixed, so that their order is that of any GPU
_ADDED = 32  # partial sums read at once
_WIDE = int(layout.WIDE.value)
_PART = int(layout.PART.value)
_PHASE = int(layout.PHASE.value)
_SOLVABLE, _CONVERGED = 1.5, 1.0


def align(
    models: list[ModelLevel],
    frames: list[FrameLevel],
    start: Alignment,
    options: GaussNewtonOptions,
) -> Alignment:
    """Gauss-Newton from coarse to fine. Nothing is copied to the host before the end.

    Args:
        models, frames: levels from fine to coarse, on one device.
    """
    device = frames[0].depth_m.device
    weight = options.photometric_weight
    state = _state_of(start, device)
    parts = torch.empty(_PARTS, _PART, device=device)
    last = torch.zeros(_WIDE, _WIDE, dtype=torch.float64, device=device)
    with on(device):
        for level in range(len(models) - 1, -1, -1):
            state[_PHASE].mul_(state[_PHASE] > _SOLVABLE)
            images = models[level], frames[level]
            cameras = _intrinsics(*images)
            gate = options.max_distance * 2**level
            for _ in range(options.iterations):
                count = _accumulate(*images, cameras, (state, parts), gate, weight)
                _advance((parts, state, last), count, options, level)
    return _read(state, last)


def linearise(
    model: ModelLevel,
    frame: FrameLevel,
    T_model_frame: NDArray[np.float64],
    scales: ResidualScales,
    exposure: Exposure,
    max_distance: float,
) -> Linearisation:
    """See AlignmentBackend."""
    device = frame.depth_m.device
    state = _state_of(Alignment(T_model_frame, scales, exposure), device)
    parts = torch.empty(_PARTS, _PART, device=device)
    cameras = _intrinsics(model, frame)
    with on(device):
        weight = scales.photometric_weight
        count = _accumulate(model, frame, cameras, (state, parts), max_distance, weight)
    return _unpack(parts[:count].double().sum(0).view(_WIDE, _WIDE).cpu().numpy())


def _state_of(start: Alignment, device: torch.device) -> Tensor:
    numbers = np.zeros(layout.STATE)
    numbers[:12] = start.T_view_camera[:3].reshape(-1)
    numbers[12:14] = start.exposure.gain, start.exposure.bias
    numbers[14:16] = start.scales.intensity, start.scales.depth_m
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
    """Launch the sums of one step; returns the number of partial sums."""
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


def _advance(
    tensors: tuple[Tensor, Tensor, Tensor], count: int, options: GaussNewtonOptions, level: int
) -> None:
    """Launch one step from its partial sums."""
    parts, state, last = tensors
    previous = options.exposure or IDENTITY
    stepping.advance[(1,)](
        parts,
        state,
        last,
        count,
        previous.gain,
        previous.bias,
        options.photometric_weight,
        EXPOSURE_PRIOR,
        options.min_pixels,
        options.min_translation_m * 4**level,
        options.min_rotation_rad * 4**level,
        MIN_SCALES.intensity,
        MAX_SCALES.intensity,
        MIN_SCALES.depth_m,
        MAX_SCALES.depth_m,
        ROWS=_ADDED,
        EXPOSURE=options.exposure is not None and level == 0,
        num_warps=8,
    )


def _read(state: Tensor, last: Tensor) -> Alignment:
    """Copy the result to the host, once."""
    numbers = torch.cat([state, last.view(-1)]).cpu().numpy()
    T = np.eye(4)
    T[:3] = numbers[:12].reshape(3, 4)
    gain, bias, intensity, depth_m, steps, phase = (float(x) for x in numbers[12:18])
    return Alignment(
        se3.orthonormalise(T),
        ResidualScales(intensity, depth_m),
        Exposure(gain, bias),
        int(steps),
        phase == _CONVERGED,
        _unpack(numbers[layout.STATE :].reshape(_WIDE, _WIDE)) if steps else None,
    )


def _unpack(sums: NDArray[np.float64]) -> Linearisation:
    return Linearisation.from_squares(sums[:8, :8].copy(), sums[:8, 8].copy(), sums[-1, :5])
