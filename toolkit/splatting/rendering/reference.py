"""Reference renderer in plain torch: simple, differentiable by autograd, any float dtype.

All other backends are tested against it. It is also the fallback without compiled kernels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import (
    BASE_CHANNELS,
    DEPTH_SUM,
    MAX_ALPHA,
    MIN_ALPHA,
    NEAR_M,
    TILE,
)
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids, harmonic_basis, rotation_matrices
from toolkit.splatting.rendering.backend import GaussianGradients, tile_counts

# The Jacobian of ellipsoids is evaluated at most this far from the image's centre, in half sizes.
_MAX_SLOPE = 1.3


def composite(
    gaussians: GaussianCloud,
    camera: Camera,
    T_camera_map: Tensor,
    features: Tensor | None = None,
    region: Tensor | None = None,
) -> Tensor:
    """Render images [5 + S, H, W] of the Gaussians (H-19, H-20, G-1), differentiable in all inputs.

    Ellipsoids are rendered as by 3DGS (Kerbl et al. 2023), with pixel centres at integers.

    Args:
        T_camera_map: [3, 4] or [4, 4] tensor of the cloud's dtype, may require gradients.
        features: [N, S] or None.
        region: [rows, columns] bool, tiles to render; other tiles are zero.
    """
    finite = torch.isfinite(gaussians.means).all(dim=1, keepdim=True)
    means = torch.where(finite, gaussians.means, torch.zeros_like(gaussians.means))
    points = means @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
    visible = ((points[:, 2] > NEAR_M) & finite[:, 0]).nonzero().squeeze(1)
    # Front to back; Gaussians of equal depth keep their order in the map.
    order = visible[torch.sort(points[visible, 2].detach(), stable=True).indices]
    cloud, points = gaussians.select(order), points[order]
    x, y, z = points.unbind(1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    covariance, gain, depth_covariance = footprint(cloud, camera, points, T_camera_map[:3, :3])
    opacity = cloud.opacity_logits.sigmoid() * gain
    values = [seen_colours(cloud, T_camera_map), z[:, None], torch.ones_like(z)[:, None]]
    if features is not None:
        values.append(features[order])
    value = torch.cat(values, dim=1)

    with torch.no_grad():
        support = (2.0 * torch.log((opacity / MIN_ALPHA).clamp(min=1.0))).sqrt()
        across, down = (support * covariance[:, k, k].sqrt() + 1e-3 for k in range(2))
    conic = torch.linalg.inv(covariance)
    slope = (conic @ depth_covariance[:, :, None])[:, :, 0]
    rows, columns = tile_counts(camera)
    strips = []
    for row in range(rows):
        tiles = []
        for column in range(columns):
            left, top = column * TILE, row * TILE
            right = min(left + TILE, camera.width)
            bottom = min(top + TILE, camera.height)
            near = (u + across >= left) & (u - across <= right - 1)
            near &= (v + down >= top) & (v - down <= bottom - 1)
            if region is not None and not region[row, column]:
                near = torch.zeros_like(near)
            inside = near.nonzero().squeeze(1)
            gridded = torch.meshgrid(
                torch.arange(top, bottom, dtype=u.dtype, device=u.device),
                torch.arange(left, right, dtype=u.dtype, device=u.device),
                indexing="ij",
            )
            weights = _weights(gridded, u[inside], v[inside], conic[inside], opacity[inside])
            tile = torch.einsum("nyx,nc->cyx", weights, value[inside])
            dx, dy = gridded[1] - u[inside, None, None], gridded[0] - v[inside, None, None]
            inclined = slope[inside, 0, None, None] * dx + slope[inside, 1, None, None] * dy
            depth = torch.zeros_like(tile)
            depth[DEPTH_SUM] = (weights * inclined).sum(dim=0)
            tiles.append(tile + depth)
        strips.append(torch.cat(tiles, dim=2))
    return torch.cat(strips, dim=1)


def footprint(
    cloud: GaussianCloud, camera: Camera, points: Tensor, R_camera_map: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return covariances [n, 2, 2] in squared pixels, factors [n] of the opacities, covariances
    [n, 2] of the pixel and the depth.

    Args:
        points: [n, 3] centres in camera coordinates.
        R_camera_map: [3, 3], or [n, 3, 3].

    A sphere remains round, and its depth is that of its centre. An ellipsoid is projected by the
    Jacobian at its centre, which is evaluated near the image at most, as in 3DGS; its depth is the
    mean depth of the Gaussian at the pixel.
    """
    identity = torch.eye(2, dtype=points.dtype, device=points.device)
    z = points[:, 2]
    if cloud.ellipsoids is None:
        sigma = camera.focal * cloud.log_radii.exp() / z
        bare = sigma[:, None, None] ** 2 * identity
        with_depth = bare.new_zeros(len(points), 2)
    else:
        x, y = (points[:, k] / z for k in range(2))
        x = _limited(x, camera.fx, camera.cx, camera.width)
        y = _limited(y, camera.fy, camera.cy, camera.height)
        zero = torch.zeros_like(z)
        J = torch.stack(
            [
                torch.stack([camera.fx / z, zero, -camera.fx * x / z], dim=1),
                torch.stack([zero, camera.fy / z, -camera.fy * y / z], dim=1),
            ],
            dim=1,
        )
        shapes = cloud.ellipsoids
        axes = rotation_matrices(shapes.rotations) * shapes.log_scales.exp()[:, None]
        M, Mz = J @ R_camera_map @ axes, (R_camera_map[..., 2:, :] @ axes)[:, 0]
        bare = M @ M.transpose(1, 2)
        with_depth = (M @ Mz[:, :, None])[:, :, 0]
    if cloud.low_pass.variance_px2 == 0:
        return bare, torch.ones_like(z), with_depth
    filtered = bare + cloud.low_pass.variance_px2 * identity
    if not cloud.low_pass.compensated:
        return filtered, torch.ones_like(z), with_depth
    gain = (_determinants(bare).clamp(min=0) / _determinants(filtered)).sqrt()
    return filtered, gain, with_depth


def _determinants(matrices: Tensor) -> Tensor:
    """Return the determinants [n] of symmetric matrices [n, 2, 2]."""
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] ** 2


def _limited(slope: Tensor, focal: float, centre: float, size: int) -> Tensor:
    half, middle = 0.5 * _MAX_SLOPE * size / focal, (0.5 * (size - 1) - centre) / focal
    return slope.clamp(middle - half, middle + half)


def seen_colours(cloud: GaussianCloud, T_camera_map: Tensor) -> Tensor:
    """Return colours [n, 3] as seen from a camera at T_camera_map [3, 4], or one of [n, 3, 4]."""
    if cloud.ellipsoids is None:
        return cloud.colours
    centre = -(T_camera_map[..., :3, :3].mT @ T_camera_map[..., :3, 3:])[..., 0]
    directions = torch.nn.functional.normalize(cloud.means - centre, dim=1)
    harmonics = cloud.ellipsoids.harmonics
    basis = harmonic_basis(directions, harmonics.shape[1])
    return (cloud.colours + torch.einsum("nk,nkc->nc", basis, harmonics)).clamp(min=0)


def _weights(
    grid: tuple[Tensor, ...], u: Tensor, v: Tensor, conic: Tensor, opacity: Tensor
) -> Tensor:
    """Return the compositing weights [n, y, x]: alpha times accumulated transmittance."""
    dx, dy = grid[1] - u[:, None, None], grid[0] - v[:, None, None]
    A, B, C = (conic[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    alpha = opacity[:, None, None] * torch.exp(-0.5 * (A * dx**2 + C * dy**2) - B * dx * dy)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp(max=MAX_ALPHA), torch.zeros_like(alpha))
    passed = torch.cumprod(1.0 - alpha, dim=0)
    passed = torch.cat([torch.ones_like(passed[:1]), passed[:-1]])
    return alpha * passed


def as_leaves(
    gaussians: GaussianCloud, features: Tensor, T_camera_map: NDArray[np.float64]
) -> tuple[GaussianCloud, Tensor, Tensor]:
    """Return cloud, features and pose [3, 4] as leaves of a new graph, on one device."""
    T = torch.as_tensor(T_camera_map[:3]).to(gaussians.means).requires_grad_()
    cloud = gaussians.detached().mapped(torch.Tensor.requires_grad_)
    return cloud, features.detach().requires_grad_(), T


class ReferenceForwardPass:
    """A view whose backward pass uses autograd."""

    def __init__(
        self, cloud: GaussianCloud, T_camera_map: Tensor, features: Tensor, images: Tensor
    ):
        self._cloud, self._T, self._features = cloud, T_camera_map, features
        self._images = images
        self.images = images.detach()

    def backward(
        self, image_gradients: Tensor, colours: bool = True, detached: bool = False
    ) -> GaussianGradients:
        """See ForwardPass.backward."""
        cloud = self._cloud
        inputs = [cloud.means, cloud.log_radii, cloud.opacity_logits, cloud.colours]
        inputs += [self._features, self._T]
        shapes = cloud.ellipsoids
        if shapes is not None:
            inputs += shapes.tensors().values()
        with torch.enable_grad():  # autograd calls backward with gradient recording disabled
            images = self._images[: len(image_gradients)]  # only 5 channels without features
            base = images[:BASE_CHANNELS]
        full = self._gradients(base if detached else images, inputs, image_gradients)
        if detached:
            full[4] = self._gradients(images, inputs[4:5], image_gradients)[0]
        return GaussianGradients(
            ids=torch.arange(len(cloud), device=cloud.means.device),
            means=full[0],
            log_radii=full[1],
            opacity_logits=full[2],
            colours=full[3] if colours else None,
            features=full[4],
            T_camera_map=full[5].to(torch.float64),
            ellipsoids=Ellipsoids(*full[6:]) if shapes is not None else None,
        )

    @staticmethod
    def _gradients(images: Tensor, inputs: list[Tensor], by_images: Tensor) -> list[Tensor]:
        if not images.requires_grad:  # no Gaussian is visible
            return [torch.zeros_like(x) for x in inputs]
        found = torch.autograd.grad(
            images, inputs, by_images[: len(images)], retain_graph=True, allow_unused=True
        )
        return [torch.zeros_like(x) if g is None else g for g, x in zip(found, inputs, strict=True)]


def forward_by_autograd(
    render_images: Callable[[GaussianCloud, Tensor, Tensor], Tensor],
    gaussians: GaussianCloud,
    T_camera_map: NDArray[np.float64],
    features: Tensor | None,
    centres: bool,
) -> ReferenceForwardPass:
    """Render a view with a differentiable function; the backward pass uses autograd.

    Args:
        render_images: renders images [5 + S, H, W] of a cloud, T_camera_map [3, 4] and channels
            [N, S].
        gaussians, T_camera_map, features, centres: see `Backend.forward`.
    """
    if features is None:
        features = gaussians.means.new_zeros(len(gaussians), 0)
    with torch.enable_grad():
        cloud, features, T = as_leaves(gaussians, features, T_camera_map)
        extra = torch.cat([features, cloud.means.detach()], dim=1) if centres else features
        images = render_images(cloud, T, extra)
    return ReferenceForwardPass(cloud, T, features, images)


class ReferenceBackend:
    """Rendering backend in plain torch."""

    name = "reference"

    def forward(
        self,
        gaussians: GaussianCloud,
        camera: Camera,
        T_camera_map: NDArray[np.float64],
        features: Tensor | None,
        region: Tensor | None,
        centres: bool = False,
    ) -> ReferenceForwardPass:
        """See Backend.forward."""

        def render_images(cloud: GaussianCloud, T: Tensor, extra: Tensor) -> Tensor:
            return composite(cloud, camera, T, extra, region)

        return forward_by_autograd(render_images, gaussians, T_camera_map, features, centres)
