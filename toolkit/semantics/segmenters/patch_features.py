"""Features of an image's patches from a vision transformer, DINOv2 above all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.pretrained.vision_transformer import VisionTransformer


class PatchEncoder:
    """One feature vector for each patch of an image; arguments and errors as its model's.

    Attributes:
        channels: length D of a feature vector.
        longest_side: as given.
    """

    def __init__(self, folder: Path, longest_side: int = 518, device: str = "auto") -> None:
        self._model = VisionTransformer(folder, longest_side, device)
        self.channels = self._model.channels
        self.longest_side = longest_side

    @property
    def digest(self) -> str:
        """SHA-256 of the weights: a head fits the encoder it was trained on, and no other."""
        return self._model.digest

    def features(self, rgb: NDArray[np.float32]) -> torch.Tensor:
        """Features [rows, columns, D] float32 of the patches of an image.

        Args:
            rgb: [H, W, 3] in [0, 1]; it is scaled as a whole, so that patches cover all of it.
        """
        image = torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1)[None]
        with torch.no_grad():
            return self._model.tokens(image).patches[0]
