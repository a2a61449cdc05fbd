"""Colour and depth losses with their derivatives (H-24, G-3, G-4)."""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

import torch
from torch import Tensor

from toolkit.base.native import address, kernels_for
from toolkit.base.native.constants import (
    DEPTH_SUM,
    MIN_NOISE_DEPTH_M,
    SILHOUETTE,
    SSIM_K1,
    SSIM_K2,
    SSIM_SIGMA_PX,
    SSIM_WINDOW,
)
from toolkit.splatting.losses.options import RgbdLossWeights
from toolkit.splatting.rendering.output import COLOUR
from toolkit.splatting.rendering.surface import SurfaceView

_MIN_SILHOUETTE = 1e-6


def rgbd_loss(
    view: SurfaceView,
    rgb: Tensor,
    depth_m: Tensor,
    weights: RgbdLossWeights,
    out: Tensor | None = None,
) -> tuple[float, Tensor]:
    """Compute the mapping loss of a rendered view and its derivative by the rendered images.

    The depth term compares the surface depth. Its difference from the mean depth is treated as a
    constant, so that the derivative is propagated to the mean depth.

    Args:
        rgb: [3, H, W] observed colour. depth_m: [H, W] observed depth, 0 where missing.
        out: [5, H, W] output tensor of the gradient, or None to allocate one.

    Returns:
        The mean over pixels, and the gradient [5, H, W] of the **sum** over pixels, so that
        the gradient of a Gaussian does not depend on the image size.
    """
    images = view.images
    module = kernels_for(images)
    gradient = torch.empty_like(images) if out is None else out
    if module is None:
        value, found = _rgbd_loss_torch(view, rgb, depth_m, weights)
        return value, gradient.copy_(found)
    value = module.rgbd_loss(
        (images.shape[2], images.shape[1]),
        [address(t) for t in (images, rgb, depth_m, view.depth_m)],
        astuple(weights),
        address(gradient),
    )
    return value, gradient


def _rgbd_loss_torch(
    view: SurfaceView, rgb: Tensor, depth_m: Tensor, weights: RgbdLossWeights
) -> tuple[float, Tensor]:
    """Compute the loss and its gradient with autograd: the fallback without native kernels."""
    # By default, convolution gradients on a GPU are not deterministic and use TF32.
    steady = torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False)
    with torch.enable_grad(), steady:
        leaf = view.images.detach().clone().requires_grad_()
        value = rgbd_loss_torch(leaf, view.depth_m, (rgb, depth_m), weights)
        (gradient,) = torch.autograd.grad(value, leaf)
    return float(value.detach()), gradient * depth_m.numel()


def rgbd_loss_torch(
    images: Tensor, surface_m: Tensor, observed: tuple[Tensor, Tensor], weights: RgbdLossWeights
) -> Tensor:
    """Compute the mean loss as a differentiable scalar: reference of the native kernel.

    Args:
        images: [5, H, W]. surface_m: [H, W]. observed: colour [3, H, W] and depth [H, W].
    """
    rgb, depth_m = observed
    colour, silhouette = images[COLOUR], images[SILHOUETTE]
    flat = _charbonnier(colour - rgb, images.new_tensor(weights.colour_scale)).mean()
    structural = 1.0 - ssim_torch(colour, rgb)
    value = weights.colour * ((1 - weights.structure) * flat + weights.structure * structural)
    measured = depth_m > 0
    solid = measured & (surface_m > 0) & (silhouette > weights.min_silhouette)
    safe = torch.where(solid, silhouette, torch.ones_like(silhouette))
    scale = weights.depth_scale_m * (depth_m**2).clamp(min=MIN_NOISE_DEPTH_M**2)
    mean = images[DEPTH_SUM] / safe
    offset = (surface_m - mean).detach()
    error = torch.where(solid, mean + offset - depth_m, torch.zeros_like(depth_m))
    value = value + weights.depth * _charbonnier(error, scale).mean()
    return value + weights.silhouette * ((1.0 - silhouette) * measured).mean()


def _charbonnier(error: Tensor, scale: Tensor) -> Tensor:
    return scale * ((1.0 + (error / scale) ** 2).sqrt() - 1.0)


def mean_ssim(x: Tensor, y: Tensor) -> Tensor:
    """Compute the mean SSIM of images [C, H, W] as `ssim_torch`, differentiable in `x` only.

    float32 images in CPU memory are compared by the native kernel.
    """
    if x.dtype == torch.float32 and kernels_for(x) is not None:
        found: Tensor = _NativeSsim.apply(x.contiguous(), y.contiguous())
        return found
    return ssim_torch(x, y.detach())


class _NativeSsim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        module = kernels_for(x)
        assert module is not None
        gradient = torch.zeros_like(x)
        shape = (x.shape[0], x.shape[1], x.shape[2])
        value = module.mean_ssim(address(x), address(y), shape, 1.0 / x.numel(), address(gradient))
        ctx.save_for_backward(gradient)
        return x.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, *by_value: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return by_value[0] * gradient, None


def ssim_torch(x: Tensor, y: Tensor) -> Tensor:
    """Compute the mean SSIM of images [C, H, W] with a Gaussian window and zero padding."""
    offsets = torch.arange(SSIM_WINDOW, dtype=x.dtype, device=x.device) - SSIM_WINDOW // 2
    window = torch.exp(-0.5 * (offsets / SSIM_SIGMA_PX) ** 2)
    window = window / window.sum()

    def blur(images: Tensor) -> Tensor:
        column = torch.nn.functional.conv2d(
            images[:, None], window.view(1, 1, -1, 1), padding=(SSIM_WINDOW // 2, 0)
        )
        return torch.nn.functional.conv2d(
            column, window.view(1, 1, 1, -1), padding=(0, SSIM_WINDOW // 2)
        )[:, 0]

    # Concatenated, so that two convolutions suffice instead of ten.
    means = blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    mean_x, mean_y = means[:2]
    variance_x = means[2] - mean_x**2
    variance_y = means[3] - mean_y**2
    covariance = means[4] - mean_x * mean_y
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return (luminance * structure).mean()


def weigh_depth(gradient: Tensor, images: Tensor, mask: Tensor, weight: float) -> None:
    """Multiply the gradient of the depth loss by a weight in some pixels, in place.

    Args:
        gradient: [C, H, W] of the mapping loss by the rendered images.
        images: [C, H, W] the rendered images.
        mask: [H, W] bool, the pixels.
        weight: factor of the depth loss there; other losses keep theirs.
    """
    removed = (1.0 - weight) * gradient[DEPTH_SUM] * mask
    mean = images[DEPTH_SUM] / images[SILHOUETTE].clamp(min=_MIN_SILHOUETTE)
    gradient[DEPTH_SUM] -= removed
    # d(D / S) / dS = -(D / S) / S.
    gradient[SILHOUETTE] += removed * mean


def by_observed_depth(gradient: Tensor, images: Tensor) -> Tensor:
    """Derivative [H, W] of the depth loss, summed over pixels, by the observed depth.

    Args:
        gradient: [C, H, W] of the mapping loss by the rendered images.
        images: [C, H, W] the rendered images.
    """
    return -gradient[DEPTH_SUM] * images[SILHOUETTE]
