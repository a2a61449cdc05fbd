"""Rendering on another device than the one that stores the Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from toolkit.splatting.rendering.backend import ForwardPass, GaussianGradients


class TransferredForwardPass:
    """A forward pass whose images and gradients are copied to another device.

    Args:
        forward_pass: the view, rendered on any device.
        device: device of the Gaussians, to which images and gradients are copied.
    """

    def __init__(self, forward_pass: ForwardPass, device: torch.device) -> None:
        self._forward_pass, self._device = forward_pass, device
        self.images = forward_pass.images.to(device)

    def backward(
        self, image_gradients: Tensor, colours: bool = True, detached: bool = False
    ) -> GaussianGradients:
        """See ForwardPass.backward."""
        render_device = self._forward_pass.images.device
        gradients = self._forward_pass.backward(
            image_gradients.to(render_device), colours, detached
        )
        return gradients.to(self._device)
