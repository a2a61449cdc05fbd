"""Patch features from a vision transformer, for instance DINOv2."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from toolkit.base.frame import Frame
from toolkit.semantics.features.pretrained.vision_transformer import VisionTransformer


class PatchEncoder:
    """Computes one feature vector per image patch; arguments and errors of `VisionTransformer`.

    Attributes:
        channels: length D of a feature vector.
        longest_side: longest side of the model's input image in pixels.
    """

    def __init__(self, folder: Path, longest_side: int = 518, device: str = "auto") -> None:
        self._model = VisionTransformer(folder, longest_side, device)
        self.channels = self._model.channels
        self.longest_side = longest_side

    @property
    def digest(self) -> str:
        """SHA-256 of the weights; identifies the encoder that a head was trained on."""
        return self._model.digest

    def features(self, frame: Frame) -> torch.Tensor:
        """Return the features [rows, columns, D] float32 of the patches of an image.

        The image is scaled, not cropped.
        """
        image = torch.from_numpy(np.ascontiguousarray(frame.rgb)).permute(2, 0, 1)[None]
        with torch.no_grad():
            return self._model.tokens(image).patches[0]
