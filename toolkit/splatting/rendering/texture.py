"""Correction of the position of rendered colours.

Front-to-back compositing gives the nearer of two overlapping Gaussians more weight. On a slanted
surface, the colour of a pixel is therefore that of a surface point up to half a pixel off its
ray, always on the nearer side, so the offset changes with the camera pose. If colours are fitted
at the pixels, the map stores the offset of its latest views, and tracking against it lags behind
the camera's motion. Colours are therefore fitted at the projection of the mean centre, and
rendered intensities are shifted there before a frame is compared with them. On a synthetic room
this reduced the trajectory error from 0.23 to 0.06 cm.
"""

from __future__ import annotations

import torch
from torch import Tensor

from toolkit.base.native import address, kernels_for
from toolkit.base.native.constants import MAX_CENTRE_OFFSET_PX, MIN_CENTRE_DEPTH_M, SILHOUETTE
from toolkit.splatting.rendering.surface import SurfaceView, kernel_geometry


def centre_offsets(view: SurfaceView, min_silhouette: float) -> Tensor:
    """Return the offsets [2, H, W] (pixels) from each pixel to the projection of its mean centre.

    Offsets are zero where the silhouette is below `min_silhouette` and at depth edges.
    """
    camera, images = view.camera, view.forward_pass.images
    T = torch.as_tensor(view.T_camera_map).to(images)
    solid = images[SILHOUETTE] >= min_silhouette
    mean = images[-3:] / torch.where(solid, images[SILHOUETTE], torch.ones_like(images[SILHOUETTE]))
    points = torch.einsum("ij,jyx->iyx", T[:3, :3], mean) + T[:3, 3, None, None]
    solid &= points[2] > MIN_CENTRE_DEPTH_M
    z = torch.where(solid, points[2], torch.ones_like(points[2]))
    y, x = (torch.arange(n, device=images.device).to(images) for n in images.shape[1:])
    across = camera.fx * points[0] / z + camera.cx - x
    down = camera.fy * points[1] / z + camera.cy - y[:, None]
    near = solid & (across.abs() <= MAX_CENTRE_OFFSET_PX) & (down.abs() <= MAX_CENTRE_OFFSET_PX)
    return torch.where(near, torch.stack([across, down]), torch.zeros_like(images[:2]))


def resample_at_centres(rgb: Tensor, view: SurfaceView, min_silhouette: float = 0.5) -> Tensor:
    """Resample an observed image [3, H, W] at the projections of the view's mean centres."""
    images = view.forward_pass.images
    module = kernels_for(images)
    if module is None:
        return _sampled(rgb, centre_offsets(view, min_silhouette))
    rgb = rgb.contiguous()
    out = torch.empty_like(rgb)
    module.texture_at_centres(
        *kernel_geometry(view.camera, view.T_camera_map),
        address(images),
        address(images[-3:]),
        min_silhouette,
        address(rgb),
        address(out),
    )
    return out


def centred_intensity(view: SurfaceView, min_silhouette: float) -> Tensor | None:
    """Compute the intensity [H, W] of a view, shifted to the mean centres, with the native kernel.

    The intensity is 0 where the silhouette is below `min_silhouette`; pixels next to those are
    not shifted. Returns None if the kernels are not available for the images' device.
    """
    images = view.forward_pass.images
    module = kernels_for(images)
    if module is None:
        return None
    intensity = images.new_empty(images.shape[1:])
    module.centred_intensity(
        *kernel_geometry(view.camera, view.T_camera_map),
        address(images),
        address(images[-3:]),
        min_silhouette,
        address(intensity),
    )
    return intensity


def shift_to_centres(intensity: Tensor, view: SurfaceView, min_silhouette: float) -> Tensor:
    """Shift the intensity [H, W] of a view to the mean centres: the native kernel in torch."""
    if min(intensity.shape) < 3:
        return intensity
    solid = view.forward_pass.images[SILHOUETTE] >= min_silhouette
    inner = solid[1:-1, 1:-1] & solid[1:-1, :-2] & solid[1:-1, 2:] & solid[:-2, 1:-1]
    inner &= solid[2:, 1:-1]
    across, down = centre_offsets(view, min_silhouette)[:, 1:-1, 1:-1]
    along_x = 0.5 * (intensity[1:-1, 2:] - intensity[1:-1, :-2])
    along_y = 0.5 * (intensity[2:, 1:-1] - intensity[:-2, 1:-1])
    moved = intensity[1:-1, 1:-1] - along_x * across - along_y * down
    out = intensity.clone()
    out[1:-1, 1:-1] = torch.where(inner, moved, intensity[1:-1, 1:-1])
    return out


def _sampled(rgb: Tensor, offsets: Tensor) -> Tensor:
    """Sample an image [3, H, W] bilinearly at offsets from the pixels; the border is replicated."""
    height, width = rgb.shape[1:]
    y, x = (torch.arange(n, device=rgb.device).to(rgb) for n in (height, width))
    u = (x + offsets[0]).clamp(0, width - 1)
    v = (y[:, None] + offsets[1]).clamp(0, height - 1)
    left, top = u.floor().clamp(max=max(width - 2, 0)), v.floor().clamp(max=max(height - 2, 0))
    a, b = u - left, v - top
    at = (top * width + left).long()
    right, below = min(1, width - 1), min(1, height - 1) * width
    flat = rgb.reshape(3, -1)
    taps = [flat[:, at + step] for step in (0, right, below, below + right)]
    upper, lower = taps[0] * (1 - a) + taps[1] * a, taps[2] * (1 - a) + taps[3] * a
    return upper * (1 - b) + lower * b
