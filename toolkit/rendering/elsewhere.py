"""Views of Gaussians on the CPU that a GPU drew."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from toolkit.rendering.backend import ForwardPass, GaussianGradients


class DrawnElsewhere:
    """A drawn view; its images and gradients are brought to where the Gaussians lie.

    Args:
        home: that device.
    """

    def __init__(self, drawn: ForwardPass, home: torch.device) -> None:
        self._drawn, self._home = drawn, home
        self.images = drawn.images.to(home)

    def backward(
        self, image_gradients: Tensor, colours: bool = True, detached: bool = False
    ) -> GaussianGradients:
        """See ForwardPass.backward."""
        there = self._drawn.images.device
        found = self._drawn.backward(image_gradients.to(there), colours, detached)
        parts: dict[str, Any] = {f.name: getattr(found, f.name) for f in fields(found)}
        home: dict[str, Any] = {
            name: None if part is None else part.to(self._home) for name, part in parts.items()
        }
        return GaussianGradients(**home)
