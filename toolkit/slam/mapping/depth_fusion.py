"""Depth fusion: the centre of each Gaussian is the running mean of the depths measured there.

Mapping fits the composited images of many Gaussians, not the position of each: if they are seeded
from noisy depth, they stay scattered around the surface, and walls become as thick as the noise.
Therefore every keyframe moves the centres that it observes along their rays by a fraction of the
distance to the measured depth. The variance of the noise grows with the fourth power of the
distance, and the fraction grows accordingly for closer views. From two thirds of the previous
distance, a new measurement replaces the previous ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.base.native import address, kernels_for
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud

# Weight of a new measurement at the same distance as before, similar to a mean over the last ten.
_WEIGHT = 0.2
# Measurements with a smaller weight are skipped.
_MIN_WEIGHT = 0.02
# Maximum distance of a Gaussian from the measured surface that it belongs to: in inverse depth
# (1 / m, five standard deviations of a triangulating sensor) at the larger of the previous and the
# current distance, and as a fraction of depth.
_MAX_INVERSE_DISTANCE = 0.006
_MAX_DISTANCE = 0.05
# Neighbouring pixels whose inverse depths differ by more than this fraction are a depth edge.
_EDGE = 0.03
_MIN_DEPTH_M = 0.05


@dataclass(frozen=True)
class MeasuredCentres:
    """Centres of the Gaussians that a keyframe measures.

    Attributes:
        indices: [n] int64 indices of the Gaussians.
        centres: [n, 3] updated centres (m).
        replaced: [n] bool, centres that are determined by this keyframe's measurement alone.
    """

    indices: Tensor
    centres: Tensor
    replaced: Tensor


def fuse_depth(submap: Submap, depth_m: Tensor) -> None:
    """Move the centres that the newest keyframe of a map measures.

    Args:
        depth_m: [H, W] measured depth of that keyframe, on the map's device.
    """
    keyframes, means = submap.keyframes, submap.gaussians.means
    module = kernels_for(means)
    if module is not None:
        moved, seeded_by = means.clone(), submap.seeded_by.clone()
        _fuse_depth_native(module, moved, seeded_by, keyframes, depth_m)
        submap.move(moved)
        submap.seeded_by = seeded_by
        return
    found = measured_centres(submap.gaussians, submap.seeded_by, keyframes, depth_m)
    submap.move(means.index_copy(0, found.indices, found.centres))
    submap.seeded_by = submap.seeded_by.index_fill(
        0, found.indices[found.replaced], keyframes[-1].index
    )


def _fuse_depth_native(
    module: ModuleType,
    means: Tensor,
    seeded_by: Tensor,
    keyframes: Sequence[Keyframe],
    depth_m: Tensor,
) -> None:
    """As `measured_centres`; changes the centres [N, 3] and their keyframes [N] in place."""
    newest, camera, depth_m = keyframes[-1], keyframes[-1].camera, depth_m.contiguous()
    indices = np.array([k.index for k in keyframes], np.int32)
    positions = np.array([k.T_map_camera[:3, 3] for k in keyframes], np.float32)
    module.fuse_depth(
        (address(means), address(seeded_by)),
        len(means),
        address(depth_m),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        (camera.width, camera.height),
        se3.inverse(newest.T_map_camera)[:3].ravel(),
        newest.T_map_camera[:3, 3],
        (indices.ctypes.data, positions.ctypes.data),
        len(keyframes),
        (_WEIGHT, _MIN_WEIGHT, _MAX_INVERSE_DISTANCE, _MAX_DISTANCE, _EDGE, _MIN_DEPTH_M),
    )


def measured_centres(
    gaussians: GaussianCloud,
    seeded_by: Tensor,
    keyframes: Sequence[Keyframe],
    depth_m: Tensor,
) -> MeasuredCentres:
    """Update the centres with the depth of the newest keyframe.

    In torch: reference and fallback of the native kernel, and for GPUs.

    Args:
        gaussians: N Gaussians.
        seeded_by: [N] int32 frame index of the keyframe whose measurement a centre started from.
        keyframes: in order of their indices, the newest one last.
        depth_m: [H, W] measured depth of the newest keyframe, on the device of the Gaussians.
    """
    means, newest = gaussians.means, keyframes[-1]
    frame_indices = torch.tensor(
        [k.index for k in keyframes], dtype=torch.int64, device=means.device
    )
    positions = np.array([k.T_map_camera[:3, 3] for k in keyframes], np.float32)
    T_camera_map = torch.from_numpy(se3.inverse(newest.T_map_camera)).to(means)
    points = means @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
    indices = _in_view(points, newest).nonzero().squeeze(1)
    points, seen = points.index_select(0, indices), means.index_select(0, indices)

    seeded_by = seeded_by.index_select(0, indices).long()
    row = torch.searchsorted(frame_indices, seeded_by).clamp(max=len(keyframes) - 1)
    measured_from = torch.from_numpy(positions).to(means).index_select(0, row)
    previous_m = (seen - measured_from).norm(dim=1)
    ratio = previous_m / points.norm(dim=1).clamp(min=_MIN_DEPTH_M)
    weight = (_WEIGHT * ratio**4).clamp(max=1.0)
    depth = _surface_depth(depth_m, newest, points)
    noise = _MAX_INVERSE_DISTANCE * torch.maximum(previous_m, depth) ** 2
    on_surface = (depth - points[:, 2]).abs() < torch.minimum(noise, _MAX_DISTANCE * depth)
    measured = ((weight > _MIN_WEIGHT) & on_surface).nonzero().squeeze(1)

    weight = weight.index_select(0, measured)
    position = torch.from_numpy(newest.T_map_camera[:3, 3]).to(means)
    along = depth.index_select(0, measured) / points[:, 2].index_select(0, measured)
    scale = 1.0 + weight * (along - 1.0)
    centres = position + scale[:, None] * (seen.index_select(0, measured) - position)
    return MeasuredCentres(indices.index_select(0, measured), centres, weight >= 1.0)


def _in_view(points: Tensor, keyframe: Keyframe) -> Tensor:
    """Mask [N] of the points [N, 3] in camera coordinates that project between four pixels."""
    camera = keyframe.camera
    x, y, z = points.unbind(dim=1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (u >= 0) & (v >= 0) & (u < camera.width - 1) & (v < camera.height - 1)
    return inside & (z > _MIN_DEPTH_M)


def _surface_depth(depth_m: Tensor, keyframe: Keyframe, points: Tensor) -> Tensor:
    """Depth [n] measured at the projections of points [n, 3] in view; 0 if none."""
    camera = keyframe.camera
    u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    column, row = u.long(), v.long()
    right, down = u - column, v - row
    inverse = torch.where(depth_m > 0, 1.0 / depth_m.clamp(min=1e-6), 0.0).reshape(-1)
    first = row * camera.width + column
    offsets = [j * camera.width + i for j in (0, 1) for i in (0, 1)]
    corners = torch.stack([inverse.index_select(0, first + offset) for offset in offsets])
    # Interpolate inverse depth, which is linear on a plane.
    weights = torch.stack(
        [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    )
    low, high = corners.min(dim=0).values, corners.max(dim=0).values
    one_surface = (low > 0) & (high - low < _EDGE * high)
    return torch.where(one_surface, 1.0 / (weights * corners).sum(dim=0).clamp(min=1e-6), 0.0)
