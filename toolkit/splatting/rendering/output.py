"""Output of all rendering backends: one image tensor with named channels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.base.native.constants import BASE_CHANNELS, DEPTH_SUM, SILHOUETTE

# Channels of the image tensor [5 + S, H, W] that backends exchange; DEPTH_SUM and SILHOUETTE are
# single channels.
COLOUR = slice(0, DEPTH_SUM)
FEATURES = slice(BASE_CHANNELS, None)

# The depth of pixels with a smaller silhouette is meaningless and set to 0.
_MIN_SILHOUETTE = 1e-4


@dataclass(frozen=True)
class RenderOutput:
    """A rendered view, differentiable if its inputs are.

    Attributes:
        images: [5 + S, H, W] float32: red, green, blue, depth sum, silhouette, features. Each
            is the sum over Gaussians of weight times value (H-19, H-20, G-1).
    """

    images: Tensor

    @property
    def colour(self) -> Tensor:
        """RGB [H, W, 3], premultiplied by the silhouette (black background)."""
        return self.images[COLOUR].permute(1, 2, 0)

    @property
    def depth_sum_m(self) -> Tensor:
        """Weighted sum of depths [H, W] in metres, not normalised by the silhouette."""
        return self.images[DEPTH_SUM]

    @property
    def silhouette(self) -> Tensor:
        """Accumulated opacity [H, W] in [0, 1]."""
        return self.images[SILHOUETTE]

    @property
    def depth_m(self) -> Tensor:
        """Normalised depth [H, W] in metres (depth sum / silhouette), 0 where empty."""
        visible = self.silhouette > _MIN_SILHOUETTE
        safe = torch.where(visible, self.silhouette, torch.ones_like(self.silhouette))
        return torch.where(visible, self.depth_sum_m / safe, torch.zeros_like(safe))

    @property
    def features(self) -> Tensor:
        """Feature channels [H, W, S], weighted sums like the colour."""
        return self.images[FEATURES].permute(1, 2, 0)
