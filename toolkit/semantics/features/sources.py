"""Descriptors of a view's colour image, semantic image, or both."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from toolkit.semantics.features.encoder import Encoder, unit_length

Source = Literal["rgb", "semantic", "both"]


class ViewDescriber:
    """Computes descriptors of views with an encoder (G encodes the semantic image).

    If both images are used, their descriptors are concatenated; the squared distance is then the
    mean of both squared distances.

    Args:
        encoder: encoder of single images.
        source: images to encode.

    Attributes:
        name: name of encoder and source.
        dimensions: descriptor dimension D.
        threshold: see `Encoder.threshold`.
    """

    def __init__(self, encoder: Encoder, source: Source = "rgb") -> None:
        self._encoder, self.source = encoder, source
        self.name = f"{encoder.name}/{source}"
        self.dimensions = encoder.dimensions * (2 if source == "both" else 1)
        self.threshold = encoder.threshold

    @property
    def wants_semantics(self) -> bool:
        """Whether `describe` needs the semantic image."""
        return self.source != "rgb"

    def describe(self, rgb: Tensor, semantic: Tensor | None = None) -> Tensor:
        """Compute descriptors [B, D] float32 of unit norm, differentiable in the images.

        Args:
            rgb: [B, 3, H, W] float32 in [0, 1].
            semantic: class colours [B, 3, H, W] float32 in [0, 1]; see `wants_semantics`.

        Raises:
            ValueError: a shape is wrong, or the semantic image is missing.
        """
        if self.source == "rgb":
            return self._encoder.describe(rgb)
        if semantic is None:
            raise ValueError(f"image source '{self.source}' needs a semantic image")
        if self.source == "semantic":
            return self._encoder.describe(semantic)
        both = [self._encoder.describe(image) for image in (rgb, semantic)]
        return unit_length(torch.cat(both, dim=1))
