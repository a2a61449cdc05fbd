"""Which tiles of a keyframe are worth another step: spend the effort where error is left."""

from __future__ import annotations

import torch
from torch import Tensor

from toolkit.mapping.keyframes import Keyframe
from toolkit.rendering import TILE


class TileFocus:
    """Lasts for one mapping call, so a checkpoint need not know it.

    A keyframe's first step sees the whole image and ranks its tiles; the following ones see
    the worst of them, and every fourth the whole again, since tiles touch each other.

    Args:
        share: of the tiles to keep in focus; 1 always takes the whole image.
    """

    WHOLE_EVERY = 4

    def __init__(self, share: float) -> None:
        self._share = share
        self._visits: dict[int, int] = {}
        self._regions: dict[int, Tensor] = {}

    def region(self, keyframe: Keyframe) -> Tensor | None:
        """Tiles [rows, columns] bool of the keyframe's next step, None for all."""
        visit = self._visits.get(keyframe.index, 0)
        self._visits[keyframe.index] = visit + 1
        if self._share >= 1.0 or visit % self.WHOLE_EVERY == 0:
            return None
        return self._regions.get(keyframe.index)

    def learn(self, keyframe: Keyframe, by_images: Tensor) -> None:
        """Rank a keyframe's tiles by how much the whole image's loss [C, H, W] pulls at them."""
        if self._share >= 1.0:
            return
        pull = by_images.abs().sum(0)[None, None]
        tiles = torch.nn.functional.avg_pool2d(pull, TILE, ceil_mode=True)[0, 0]
        kept = max(1, round(self._share * tiles.numel()))
        worst = torch.topk(tiles.view(-1), kept).indices
        region = torch.zeros(tiles.numel(), dtype=torch.bool, device=tiles.device)
        region[worst] = True
        self._regions[keyframe.index] = region.view(tiles.shape)
