"""Differentiable descriptors of rendered views, for the feature term of registration (G-6)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.features.sources import ViewDescriber
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.rendering import RenderOutput
from toolkit.rendering.output import COLOUR


@dataclass(frozen=True)
class ViewFeatures:
    """Computes descriptors of rendered views from their colours, class colours, or both.

    Attributes:
        describer: encoder, and the images of a view that it uses.
        semantics: decodes the features of the map; None without classes.
    """

    describer: ViewDescriber
    semantics: SemanticMapping | None = None

    def images(self, output: RenderOutput) -> Tensor:
        """Return the images of a view, [3, H, W] or, with classes, [6, H, W]; differentiable.

        The first three channels are the rendered colour, the others the colours of the classes.
        """
        colour = output.images[COLOUR]
        if not self.describer.wants_semantics:
            return colour
        classes = torch.zeros_like(colour)
        if self.semantics is not None and output.features.shape[-1]:
            classes = self.semantics.class_colours(output)
        return torch.cat([colour, classes])

    def describe(self, images: Tensor) -> Tensor:
        """Return the descriptor [D] of a view's images."""
        semantic = images[None, 3:] if self.describer.wants_semantics else None
        return self.describer.describe(images[None, :3], semantic)[0]
