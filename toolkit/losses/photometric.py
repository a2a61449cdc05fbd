"""Image losses with their derivatives, H-24 and G-3/G-4 in one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.rendering.native import address, kernels
from toolkit.rendering.output import COLOUR, DEPTH_SUM, SILHOUETTE

_WINDOW, _SIGMA = 11, 1.5


@dataclass(frozen=True)
class RgbdLossWeights:
    """Weights of the mapping loss.

    Attributes:
        colour: of the colour term, (1 - structure) * L1 + structure * (1 - SSIM) (G-4).
        depth: of the L1 depth term inside the silhouette mask.
        structure: share of SSIM in the colour term.
        least_silhouette: depth counts only where the map is at least this opaque.
    """

    colour: float = 0.5
    depth: float = 1.0
    structure: float = 0.2
    least_silhouette: float = 0.5


def rgbd_loss(
    images: Tensor, rgb: Tensor, depth_m: Tensor, weights: RgbdLossWeights
) -> tuple[float, Tensor]:
    """Mapping loss of a rendering and its derivative by the rendered images.

    Args:
        images: [5 + S, H, W] as a backend draws them.
        rgb: [3, H, W] observed colour. depth_m: [H, W] observed depth, 0 where missing.

    Returns:
        The value, and its gradient [5 + S, H, W].
    """
    gradient = torch.zeros_like(images)
    colour = images[COLOUR]
    difference = colour - rgb
    pixels = depth_m.numel()
    flat = weights.colour * (1.0 - weights.structure)
    value = flat * float(difference.abs().mean())
    gradient[COLOUR] = torch.sign(difference) * (flat / (3 * pixels))
    if weights.structure > 0 and weights.colour > 0:
        share = weights.colour * weights.structure
        value += share * (1.0 - add_ssim_gradient(colour, rgb, -share, gradient[COLOUR]))

    silhouette, depth_sum = images[SILHOUETTE], images[DEPTH_SUM]
    mask = (silhouette > weights.least_silhouette) & (depth_m > 0)
    inverse = torch.where(mask, 1.0 / silhouette.clamp(min=1e-6), torch.zeros_like(silhouette))
    error = torch.where(mask, depth_sum * inverse - depth_m, torch.zeros_like(depth_m))
    count = max(int(mask.sum()), 1)
    value += weights.depth * float(error.abs().sum()) / count
    by_sum = torch.sign(error) * inverse * (weights.depth / count)
    gradient[DEPTH_SUM] = by_sum
    gradient[SILHOUETTE] = -by_sum * depth_sum * inverse
    return value, gradient


def add_ssim_gradient(x: Tensor, y: Tensor, weight: float, gradient: Tensor) -> float:
    """Mean SSIM of two images [C, H, W]; adds weight * d(mean SSIM)/dx to the gradient in place.

    11x11 Gaussian window, sigma 1.5, data range 1, zero beyond the border.
    """
    module = kernels()
    if module is not None:
        x, y = x.contiguous(), y.contiguous()
        assert gradient.is_contiguous()
        return module.mean_ssim(address(x), address(y), tuple(x.shape), weight, address(gradient))
    with torch.enable_grad():
        leaf = x.detach().clone().requires_grad_()
        value = ssim_torch(leaf, y)
        (derivative,) = torch.autograd.grad(value, leaf)
    gradient += weight * derivative
    return float(value.detach())


def ssim_torch(x: Tensor, y: Tensor) -> Tensor:
    """Mean SSIM of [C, H, W] images by convolutions: the reference of the native kernel."""
    offsets = torch.arange(_WINDOW, dtype=x.dtype) - _WINDOW // 2
    window = torch.exp(-0.5 * (offsets / _SIGMA) ** 2)
    window = window / window.sum()

    def blur(image: Tensor) -> Tensor:
        column = torch.nn.functional.conv2d(
            image[:, None], window.view(1, 1, -1, 1), padding=(_WINDOW // 2, 0)
        )
        return torch.nn.functional.conv2d(
            column, window.view(1, 1, 1, -1), padding=(0, _WINDOW // 2)
        )[:, 0]

    mean_x, mean_y = blur(x), blur(y)
    variance_x = blur(x * x) - mean_x**2
    variance_y = blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return (luminance * structure).mean()
