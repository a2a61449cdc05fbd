"""Image features of rendered views, and their loss (G-6 and stage 1 of the refinement)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.splatting.rendering import RenderOutput
from toolkit.splatting.rendering.output import COLOUR


@dataclass(frozen=True)
class ViewFeatures:
    """Computes descriptors of views from their colours, class colours, or both.

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


@dataclass(frozen=True)
class FeatureLoss:
    """weight * ||F(rendered) - F(observed)||^2 for the features F of a view."""

    features: ViewFeatures
    weight: float

    @property
    def wants_semantics(self) -> bool:
        """Whether the feature channels of the map are rendered for it, and labels compared."""
        return self.features.describer.wants_semantics

    def gradient(
        self, rendered: Tensor, rgb: Tensor, labels: Tensor | None = None
    ) -> tuple[float, Tensor]:
        """Return the loss and its derivative [5 + S, H, W] times the number of pixels.

        The derivative is with respect to the rendered images. The factor matches `rgbd_loss`,
        which returns a mean over pixels and the derivative of the sum. Without labels, a loss that
        compares classes is zero.

        Args:
            rendered: [5 + S, H, W], with the feature channels if classes are compared.
            rgb: [3, H, W] observed colour.
            labels: [H, W] observed class ids; pixels with 0 (void) are not compared.
        """
        if self.wants_semantics and labels is None:
            return 0.0, torch.zeros_like(rendered)
        with torch.enable_grad():
            leaf = rendered.detach().clone().requires_grad_()
            images = self.features.images(RenderOutput(leaf))
            with torch.no_grad():
                target = self.features.describe(self._observed(rgb, labels, images))
            error = self.features.describe(images) - target
            loss = self.weight * (error * error).sum()
            (gradient,) = torch.autograd.grad(loss, leaf)
        return float(loss.detach()), gradient * rgb[0].numel()

    def _observed(self, rgb: Tensor, labels: Tensor | None, rendered: Tensor) -> Tensor:
        """Images of the observation, with the rendered classes where no class was observed."""
        if not self.wants_semantics:
            return rgb
        assert labels is not None
        assert self.features.semantics is not None
        classes = self.features.semantics.label_colours(labels)
        return torch.cat([rgb, torch.where(labels > 0, classes, rendered[3:])])
