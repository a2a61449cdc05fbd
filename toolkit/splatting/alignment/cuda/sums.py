"""Launches the Triton kernel of alignment and reads its sums."""

from __future__ import annotations

import numpy as np
import torch
import triton

from toolkit.splatting.alignment.cuda import accumulation
from toolkit.splatting.alignment.data import LevelProblem, Linearisation
from toolkit.splatting.rendering.cuda.backend import on

_BLOCK, _WARPS = 64, 2  # pixels per block and warps; more pixels would not fit the registers
_PARTS = 512  # maximum number of partial sums; fixed, so that their order is that of any GPU
_WIDE = int(accumulation.WIDE.value)


def linearise(problem: LevelProblem) -> Linearisation:
    """See AlignmentBackend."""
    model, frame = problem.model, problem.frame
    device, size = frame.depth_m.device, frame.camera.size
    gain, bias, sigma_intensity, sigma_depth, max_distance, weight = problem.parameters
    intrinsics = [n for c in (model.camera, frame.camera) for n in (c.fx, c.fy, c.cx, c.cy)]
    pose = problem.T_model_frame[:3].ravel().tolist()
    scalars = [*intrinsics, *pose, gain, bias, 1.0 / sigma_intensity, 1.0 / sigma_depth]
    chunks = triton.cdiv(size[0] * size[1], _BLOCK)
    count = min(chunks, _PARTS)
    parts = torch.empty(count, _WIDE, _WIDE, dtype=torch.float32, device=device)
    with on(device):
        accumulation.accumulate[(count,)](
            model.texture,
            model.surface,
            frame.intensity,
            frame.depth_m,
            torch.tensor(scalars, dtype=torch.float32, device=device),
            parts,
            *model.camera.size,
            *size,
            max_distance,
            float(np.sqrt(weight)),
            chunks,
            BLOCK=_BLOCK,
            num_warps=_WARPS,
        )
        sums = parts.double().sum(0).cpu().numpy()
    return Linearisation.from_squares(sums[:8, :8].copy(), sums[:8, 8].copy(), sums[-1, :5])
