"""Pyramid and model levels in torch, on the device of their inputs; see `reference`."""

from __future__ import annotations

import torch
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import SILHOUETTE
from toolkit.splatting.alignment.reference import LUMA
from toolkit.splatting.rendering.surface import same_surface


def intensity_of(images: Tensor, min_silhouette: float) -> Tensor:
    """Intensity [H, W] of a rendering [5, H, W], 0 where its silhouette is below a minimum."""
    red, green, blue = (float(x) for x in LUMA)
    luma = images[0] * red + images[1] * green + images[2] * blue
    return torch.where(images[SILHOUETTE] >= min_silhouette, luma, torch.zeros_like(luma))


def halve(intensity: Tensor, depth: Tensor, max_difference: float) -> tuple[Tensor, Tensor]:
    """Mean intensity and depth of the nearest surface in each 2x2 cell."""
    taps, grey = _taps(depth), _taps(intensity)
    nearest = torch.where(taps > 0, taps, torch.full_like(taps, 1e30)).amin(0)
    same = (taps > 0) & (taps - nearest <= max_difference * nearest)
    count = same.sum(0)
    inverse = torch.where(same, 1.0 / taps, torch.zeros_like(taps)).sum(0)
    mean = torch.where(count > 0, count / inverse.clamp(min=1e-9), torch.zeros_like(inverse))
    surface_mean = (grey * same).sum(0) / count.clamp(min=1)
    return torch.where(count > 0, surface_mean, grey.mean(0)), mean


def _taps(image: Tensor) -> Tensor:
    """The four pixels [4, H / 2, W / 2] under each pixel of the next level."""
    height, width = image.shape
    rows, columns = max(1, height // 2), max(1, width // 2)
    # The row or column of an image of size 1 is repeated.
    right, below = min(1, width - 1), min(1, height - 1)
    return torch.stack([image[y::2, x::2][:rows, :columns] for y in (0, below) for x in (0, right)])


def model(camera: Camera, intensity: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Texture and surface [H, W, 4] of one level; see ModelLevel."""
    texture = depth.new_zeros(*depth.shape, 4)
    surface = torch.zeros_like(texture)
    if min(depth.shape) < 3:
        return texture, surface
    inner = (slice(1, -1), slice(1, -1))
    z = depth[inner]
    left, right = depth[1:-1, :-2], depth[1:-1, 2:]
    above, below = depth[:-2, 1:-1], depth[2:, 1:-1]
    usable = torch.stack([z, left, right, above, below]).amin(0) > 0
    along_x = 0.5 * (intensity[1:-1, 2:] - intensity[1:-1, :-2])
    along_y = 0.5 * (intensity[2:, 1:-1] - intensity[:-2, 1:-1])
    parts = torch.stack([intensity[inner], along_x, along_y, z], dim=-1)
    texture[inner] = torch.where(usable[..., None], parts, torch.zeros_like(parts))
    smooth = usable & same_surface(left, z, right) & same_surface(above, z, below)
    y, x = (torch.arange(1, n - 1, device=z.device).to(z) for n in depth.shape)
    ray_x = (x[None] - camera.cx) / camera.fx
    ray_y = (y[:, None] - camera.cy) / camera.fy
    rays = torch.stack([ray_x.expand_as(z), ray_y.expand_as(z), torch.ones_like(z)], dim=-1)
    tangent_x = rays * (0.5 * (right - left))[..., None]
    tangent_x[..., 0] += z / camera.fx
    tangent_y = rays * (0.5 * (below - above))[..., None]
    tangent_y[..., 1] += z / camera.fy
    normal = torch.linalg.cross(tangent_x, tangent_y)
    length = normal.norm(dim=-1, keepdim=True)
    normal = normal / torch.where(length > 0, length, torch.ones_like(length))
    offset = (normal * rays).sum(-1, keepdim=True) * z[..., None]
    planes = torch.cat([normal, offset], dim=-1)
    surface[inner] = torch.where(smooth[..., None], planes, torch.zeros_like(planes))
    return texture, surface
