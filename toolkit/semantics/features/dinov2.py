"""Descriptors by DINOv2 or another vision transformer from a local folder (G-III.C)."""

from __future__ import annotations

import math
from pathlib import Path

from torch import Tensor

from toolkit.semantics.features.encoder import check_images, unit_length
from toolkit.semantics.features.pretrained.vision_transformer import VisionTransformer

# G's threshold of 0.20, interpreted as the squared distance that FAISS returns: a cosine of 0.90.
_THRESHOLD = math.sqrt(0.20)


class Dinov2Encoder:
    """The class token as a unit vector, or the mean of the patches of a model without one.

    The threshold is the paper's and was not verified.

    Args:
        folder: local folder with config.json and weights; nothing is downloaded.
        longest_side: approximate length in pixels to which the longer image side is scaled.
        device: "cpu", "cuda", or "auto".

    Attributes:
        dimensions: embedding dimension of the model, 384 for ViT-S/14.

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not available.
        FormatError: the folder is missing or does not contain a supported model.
    """

    name = "dinov2"
    threshold = _THRESHOLD
    differentiable = True

    def __init__(self, folder: Path, longest_side: int = 224, device: str = "auto") -> None:
        self._model = VisionTransformer(folder, longest_side, device)
        self.dimensions = self._model.channels

    def describe(self, images: Tensor) -> Tensor:
        """Descriptors [B, D] of images [B, 3, H, W]; see `Encoder.describe`."""
        check_images(images)
        tokens = self._model.tokens(images.float())
        token = tokens.class_token
        chosen = tokens.patches.mean(dim=(1, 2)) if token is None else token
        return unit_length(chosen).to(images.device)
