"""Each Gaussian's centre is the running mean of what keyframes measure there.

Mapping fits what many Gaussians show together, not each one's place: seeded from noisy depth,
they stay scattered about their surface, and walls are as thick as the noise. So every keyframe
moves the centres that it sees along their rays, some of the way to the depth it measured. The
noise's variance grows with the fourth power of the distance, and so does the share of the way
as a surface comes nearer: from two thirds of the distance, what was known before counts for
nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.keyframe import Keyframe
from toolkit.mapping.gaussian_map import GaussianMap

# Of the way, seen from as far as before: a mean over the last ten, or nearly.
_SHARE = 0.2
# Less of the way is not worth the work.
_LEAST_SHARE = 0.02
# A Gaussian this near to the measured depth lies on that surface: so much inverse depth (1 / m,
# five standard deviations of a sensor that triangulates), where it was measured or where it is
# now, and never more than this share of the depth.
_NOISE = 0.006
_ON_SURFACE = 0.05
# Neighbouring pixels that differ by more (share of inverse depth) show no single surface.
_EDGE = 0.03
_NEAREST_M = 0.05


@dataclass(frozen=True)
class MeasuredCentres:
    """What a keyframe says of the Gaussians it sees.

    Attributes:
        places: [n] int64 among the Gaussians. centres: [n, 3], where they lie now.
        anew: [n] bool, those whose centre is this keyframe's measurement alone.
    """

    places: Tensor
    centres: Tensor
    anew: Tensor


def fuse_depth(gaussian_map: GaussianMap, depth_m: Tensor) -> None:
    """Move the centres that the newest keyframe of a map measures.

    Args:
        depth_m: [H, W] of that keyframe, on the map's device.
    """
    keyframes = gaussian_map.keyframes
    found = measured_centres(gaussian_map.gaussians, gaussian_map.seeded_by, keyframes, depth_m)
    gaussian_map.move(gaussian_map.gaussians.means.index_copy(0, found.places, found.centres))
    gaussian_map.seeded_by = gaussian_map.seeded_by.index_fill(
        0, found.places[found.anew], keyframes[-1].index
    )


def measured_centres(
    gaussians: GaussianCloud,
    seeded_by: Tensor,
    keyframes: Sequence[Keyframe],
    depth_m: Tensor,
) -> MeasuredCentres:
    """Centres after the newest keyframe.

    Args:
        gaussians: N of them. seeded_by: [N] int32, frame index of the keyframe that measured
            each one alone.
        keyframes: in order of their indices, the newest one last.
        depth_m: [H, W] of the newest one, on the device of the Gaussians.
    """
    means, newest = gaussians.means, keyframes[-1]
    indices = torch.tensor([k.index for k in keyframes], device=means.device)
    stands = np.array([k.T_map_camera[:3, 3] for k in keyframes], np.float32)
    row = torch.searchsorted(indices, seeded_by.long()).clamp(max=len(keyframes) - 1)
    measured_from = torch.from_numpy(stands).to(means)[row]

    T_camera_map = torch.from_numpy(se3.inverse(newest.T_map_camera)).to(means)
    points = means @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
    from_m = (means - measured_from).norm(dim=1)
    nearer = from_m / points.norm(dim=1).clamp(min=_NEAREST_M)
    share = (_SHARE * nearer**4).clamp(max=1.0)
    seen = (share > _LEAST_SHARE) & (points[:, 2] > _NEAREST_M)
    (places,) = torch.nonzero(seen, as_tuple=True)
    points = points[places]
    depth = _surface_depth(depth_m, newest, points)
    gate = torch.minimum(_NOISE * torch.maximum(from_m[places], depth) ** 2, _ON_SURFACE * depth)
    on_surface = (depth - points[:, 2]).abs() < gate
    places, points, depth = places[on_surface], points[on_surface], depth[on_surface]

    share = share[places]
    eye = torch.from_numpy(newest.T_map_camera[:3, 3]).to(means)
    stretch = 1.0 + share * (depth / points[:, 2] - 1.0)
    return MeasuredCentres(places, eye + stretch[:, None] * (means[places] - eye), share >= 1.0)


def _surface_depth(depth_m: Tensor, keyframe: Keyframe, points: Tensor) -> Tensor:
    """Depth [n] of the surface where points [n, 3] in the camera's frame appear; 0 for none."""
    camera = keyframe.camera
    u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    inside = (u >= 0) & (v >= 0) & (u < camera.width - 1) & (v < camera.height - 1)
    u, v = torch.where(inside, u, 0.0), torch.where(inside, v, 0.0)
    column, row = u.long(), v.long()
    right, down = u - column, v - row
    inverse = torch.where(depth_m > 0, 1.0 / depth_m.clamp(min=1e-6), 0.0)
    corners = torch.stack([inverse[row + j, column + i] for j in (0, 1) for i in (0, 1)])
    # Linear in inverse depth, as planes are.
    weights = torch.stack(
        [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    )
    low, high = corners.min(dim=0).values, corners.max(dim=0).values
    one_surface = inside & (low > 0) & (high - low < _EDGE * high)
    return torch.where(one_surface, 1.0 / (weights * corners).sum(dim=0).clamp(min=1e-6), 0.0)
