"""Reference renderer in plain torch: simple, differentiable by autograd, any float dtype.

All other backends are tested against it. It is also the fallback without compiled kernels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.camera import Camera
from toolkit.native.constants import BASE_CHANNELS, MAX_ALPHA, MIN_ALPHA, NEAR_M, TILE
from toolkit.rendering.backend import GaussianGradients, tile_counts


def composite(
    gaussians: GaussianCloud,
    camera: Camera,
    T_camera_map: Tensor,
    features: Tensor | None = None,
    region: Tensor | None = None,
) -> Tensor:
    """Render images [5 + S, H, W] of the Gaussians (H-19, H-20, G-1), differentiable in all inputs.

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
    x, y, z = points[order].unbind(1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    sigma = camera.focal * gaussians.log_radii[order].exp() / z
    opacity = gaussians.opacity_logits[order].sigmoid()
    values = [gaussians.colours[order], z[:, None], torch.ones_like(z)[:, None]]
    if features is not None:
        values.append(features[order])
    value = torch.cat(values, dim=1)

    with torch.no_grad():
        reach = sigma * (2.0 * torch.log((opacity / MIN_ALPHA).clamp(min=1.0))).sqrt() + 1e-3
    rows, columns = tile_counts(camera)
    strips = []
    for row in range(rows):
        tiles = []
        for column in range(columns):
            left, top = column * TILE, row * TILE
            right = min(left + TILE, camera.width)
            bottom = min(top + TILE, camera.height)
            near = (u + reach >= left) & (u - reach <= right - 1)
            near &= (v + reach >= top) & (v - reach <= bottom - 1)
            if region is not None and not region[row, column]:
                near = torch.zeros_like(near)
            inside = near.nonzero().squeeze(1)
            gridded = torch.meshgrid(
                torch.arange(top, bottom, dtype=u.dtype, device=u.device),
                torch.arange(left, right, dtype=u.dtype, device=u.device),
                indexing="ij",
            )
            weights = _weights(gridded, u[inside], v[inside], sigma[inside], opacity[inside])
            tiles.append(torch.einsum("nyx,nc->cyx", weights, value[inside]))
        strips.append(torch.cat(tiles, dim=2))
    return torch.cat(strips, dim=1)


def _weights(
    grid: tuple[Tensor, ...], u: Tensor, v: Tensor, sigma: Tensor, opacity: Tensor
) -> Tensor:
    """Return the compositing weights [n, y, x]: alpha times accumulated transmittance."""
    squared = (grid[1] - u[:, None, None]) ** 2 + (grid[0] - v[:, None, None]) ** 2
    alpha = opacity[:, None, None] * torch.exp(-0.5 * squared / sigma[:, None, None] ** 2)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp(max=MAX_ALPHA), torch.zeros_like(alpha))
    passed = torch.cumprod(1.0 - alpha, dim=0)
    passed = torch.cat([torch.ones_like(passed[:1]), passed[:-1]])
    return alpha * passed


def as_leaves(
    gaussians: GaussianCloud, features: Tensor, T_camera_map: NDArray[np.float64]
) -> tuple[GaussianCloud, Tensor, Tensor]:
    """Return cloud, features and pose [3, 4] as leaves of a new graph, on one device."""
    leaves = (
        t.detach().requires_grad_()
        for t in (
            gaussians.means,
            gaussians.log_radii,
            gaussians.opacity_logits,
            gaussians.colours,
            gaussians.features,
        )
    )
    T = torch.as_tensor(T_camera_map[:3]).to(gaussians.means).requires_grad_()
    return GaussianCloud(*leaves), features.detach().requires_grad_(), T


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
