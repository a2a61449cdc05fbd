"""Which picture of a view is described: its colours, its classes, or both."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from toolkit.features.encoder import Encoder, unit_length

Source = Literal["rgb", "semantic", "both"]


class ViewDescriber:
    """Describes views by an encoder (G describes the semantic picture).

    Of both pictures, the descriptor is one behind the other: its squared distance is the mean
    of theirs.

    Args:
        encoder: of single pictures.
        source: which pictures.

    Attributes:
        name: of encoder and source.
        dimensions: length D of a descriptor.
        threshold: as `Encoder.threshold`.
    """

    def __init__(self, encoder: Encoder, source: Source = "rgb") -> None:
        self._encoder, self.source = encoder, source
        self.name = f"{encoder.name}/{source}"
        self.dimensions = encoder.dimensions * (2 if source == "both" else 1)
        self.threshold = encoder.threshold

    @property
    def wants_semantics(self) -> bool:
        """Whether `describe` needs the semantic picture."""
        return self.source != "rgb"

    def describe(self, rgb: Tensor, semantic: Tensor | None = None) -> Tensor:
        """Descriptors [B, D] float32 of unit length, differentiable in the pictures.

        Args:
            rgb: [B, 3, H, W] float32 in [0, 1].
            semantic: the classes in their palette's colours, likewise; see `wants_semantics`.

        Raises:
            ValueError: a shape is wrong, or the semantic picture is missing.
        """
        if self.source == "rgb":
            return self._encoder.describe(rgb)
        if semantic is None:
            raise ValueError(f"image source '{self.source}' needs a semantic picture")
        if self.source == "semantic":
            return self._encoder.describe(semantic)
        both = [self._encoder.describe(picture) for picture in (rgb, semantic)]
        return unit_length(torch.cat(both, dim=1))
