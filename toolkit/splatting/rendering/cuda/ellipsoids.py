"""Ellipsoids and filtered spheres: their splats, and the chain rule from splats to parameters.

Splats are computed by the equations of the reference renderer, in float64 with torch: then the
gradients of thin ellipsoids keep the precision that compositing in float32 gives them. The graph
of autograd exists only during the backward pass, for the visible Gaussians, and part by part.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.splatting.rendering.backend import GaussianGradients
from toolkit.splatting.rendering.cuda.projection import SHAPED_SPLAT
from toolkit.splatting.rendering.reference import footprint, seen_colours

# Gaussians at once. The graph of one takes up to 2.2 kB, and each part launches the kernels again.
_PART = 2**18


def is_shaped(cloud: GaussianCloud) -> bool:
    """Check whether Gaussians are more than unfiltered spheres."""
    return cloud.ellipsoids is not None or cloud.low_pass.variance_px2 > 0


@torch.no_grad()
def splats_of(cloud: GaussianCloud, camera: Camera, T_camera_map: NDArray[np.float64]) -> Tensor:
    """Return splats [N, 12] float32; see `_splats`. Those of invisible Gaussians are arbitrary."""
    pose = _pose(T_camera_map, cloud.means.device)
    cloud = _without_features(cloud)
    splats = cloud.means.new_empty(len(cloud), int(SHAPED_SPLAT.value))
    for first in range(0, len(cloud), _PART):
        part = cloud.mapped(lambda tensor: tensor[first : first + _PART].double())  # noqa: B023
        splats[first : first + _PART] = _splats(part, camera, pose.expand(len(part), 3, 4))
    return splats


def _without_features(cloud: GaussianCloud) -> GaussianCloud:
    return replace(cloud, features=cloud.features[:, :0])


def _pose(T_camera_map: NDArray[np.float64], device: torch.device) -> Tensor:
    return torch.from_numpy(np.array(T_camera_map[:3], dtype=np.float64)).to(device)


def _splats(cloud: GaussianCloud, camera: Camera, T_camera_map: Tensor) -> Tensor:
    """Return splats [n, 12] of Gaussians and a pose [3, 4] for each of them.

    Columns: u, v, a, opacity, red, green, blue, z, b, c, slope along s, slope along t. At a pixel
    (u + dx, v + dy), with s = a dx + b dy and t = c dy, the exponent is -(s^2 + t^2), because
    [[a, b], [0, c]] is a factor of half the inverse covariance; the depth is z plus slopes times s
    and t.
    """
    R, t = T_camera_map[:, :, :3], T_camera_map[:, :, 3]
    points = (R @ cloud.means[:, :, None])[:, :, 0] + t
    x, y, z = points.unbind(1)
    covariance, gain, depth_covariance = footprint(cloud, camera, points, R)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    a = (0.5 * yy / (xx * yy - xy * xy)).sqrt()
    b, c = -a * xy / yy, (0.5 / yy).sqrt()
    zx, zy = depth_covariance.unbind(1)
    centre = (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy)
    opacity = cloud.opacity_logits.sigmoid() * gain
    first = torch.stack([*centre, a, opacity], dim=1)
    last = torch.stack([z, b, c, 2.0 * (a * zx + b * zy), 2.0 * c * zy], dim=1)
    return torch.cat([first, seen_colours(cloud, T_camera_map), last], dim=1)


def _by_splats(splats: Tensor, sums: Tensor) -> Tensor:
    """Return the gradients [n, 12] of splats from their sums [n, 12] over pixels.

    Args:
        sums: see `differentiation.differentiate`.
    """
    _, _, a, opacity, *_, b, c, along_s, along_t = splats.unbind(1)
    e, e_s, e_t, e_ss, red, green, blue, d, e_st, e_tt, d_s, d_t = sums.unbind(1)
    # The moments of dx = (s - b / c t) / a and dy = t / c.
    d_x, d_y = (d_s - b / c * d_t) / a, d_t / c
    columns = [
        2.0 * a * e_s - along_s * a * d,
        2.0 * (b * e_s + c * e_t) - (along_s * b + along_t * c) * d,
        -2.0 * (e_ss - b / c * e_st) / a + along_s * d_x,
        e / opacity,
        *(red, green, blue, d),
        -2.0 * e_st / c + along_s * d_y,
        -2.0 * e_tt / c + along_t * d_y,
        *(d_s, d_t),
    ]
    return torch.stack(columns, dim=1)


def gradients_of(
    cloud: GaussianCloud,
    camera: Camera,
    T_camera_map: NDArray[np.float64],
    ids: Tensor,
    sums: Tensor,
) -> GaussianGradients:
    """Return the gradients of the V visible Gaussians and the pose; those of features are empty.

    Args:
        ids: [V] int64.
        sums: [V, 12], see `differentiation.differentiate`.
    """
    cloud = _without_features(cloud)
    names = ["means", "opacity_logits", "colours"]
    names += ["log_radii"] if cloud.ellipsoids is None else cloud.ellipsoids.tensors()
    found = {
        name: tensor.new_zeros(len(ids), *tensor.shape[1:])
        for name, tensor in cloud.tensors().items()
    }
    pose = _pose(T_camera_map, ids.device)
    by_pose = torch.zeros_like(pose)
    for first in range(0, len(ids), _PART):
        rows = slice(first, first + _PART)
        part = cloud.select(ids[rows]).mapped(lambda tensor: tensor.double().requires_grad_())
        # One pose per Gaussian, so that the order of the sum over them is fixed.
        poses = pose.expand(len(part), 3, 4).clone().requires_grad_()
        with torch.enable_grad():  # autograd calls backward with gradient recording disabled
            splats = _splats(part, camera, poses)
        leaves = [part.tensors()[name] for name in names]
        by_splats = _by_splats(splats.detach(), sums[rows].double())
        *parts, by_poses = torch.autograd.grad(splats, [*leaves, poses], by_splats)
        by_pose += by_poses.sum(dim=0)
        for name, gradient in zip(names, parts, strict=True):
            found[name][rows] = gradient
    shapes = [] if cloud.ellipsoids is None else cloud.ellipsoids.tensors()
    return GaussianGradients(
        ids=ids,
        means=found["means"],
        log_radii=found["log_radii"],
        opacity_logits=found["opacity_logits"],
        colours=found["colours"],
        features=found["features"],
        T_camera_map=by_pose,
        ellipsoids=Ellipsoids(*(found[name] for name in shapes)) if shapes else None,
    )
