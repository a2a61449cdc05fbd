"""Feature loss between rendered and observed images (G, end of III.C)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.features.encoder import Encoder


@dataclass(frozen=True)
class FeatureLoss:
    """weight * ||F(rendered) - F(observed)||^2 for an encoder F."""

    encoder: Encoder
    weight: float

    def gradient(self, rendered: Tensor, observed: Tensor) -> tuple[float, Tensor]:
        """Return the loss and its derivative [3, H, W] times the number of pixels.

        The derivative is with respect to the rendered image. The factor matches `rgbd_loss`,
        which returns a mean over pixels and the derivative of the sum.

        Args:
            rendered, observed: [3, H, W] float32, RGB.
        """
        with torch.no_grad():
            target = self.encoder.describe(observed[None])
        with torch.enable_grad():
            image = rendered.detach().clone().requires_grad_()
            error = self.encoder.describe(image[None]) - target
            loss = self.weight * (error * error).sum()
            (gradient,) = torch.autograd.grad(loss, image)
        return float(loss.detach()), gradient * image[0].numel()
