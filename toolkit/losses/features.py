"""The papers' feature term: pictures drawn are described like those seen (G, end of III.C)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.features.encoder import Encoder


@dataclass(frozen=True)
class FeatureLoss:
    """weight * ||F(drawn) - F(observed)||^2 of an encoder F."""

    encoder: Encoder
    weight: float

    def gradient(self, drawn: Tensor, observed: Tensor) -> tuple[float, Tensor]:
        """The loss, and its derivative [3, H, W] by the drawn picture times the number of pixels.

        So it stands beside `rgbd_loss`, a mean over pixels whose derivative is of the sum.

        Args:
            drawn, observed: [3, H, W] float32, RGB.
        """
        with torch.no_grad():
            wanted = self.encoder.describe(observed[None])
        with torch.enable_grad():
            picture = drawn.detach().clone().requires_grad_()
            error = self.encoder.describe(picture[None]) - wanted
            loss = self.weight * (error * error).sum()
            (by_picture,) = torch.autograd.grad(loss, picture)
        return float(loss.detach()), by_picture * picture[0].numel()
