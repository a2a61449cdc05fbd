"""Semantic loss with its derivative: intra-level and inter-level terms (H-9 to H-13)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from toolkit.base.native import address, kernels_for
from toolkit.semantics.codes import Heads, SemanticCode
from toolkit.semantics.decoder import NetworkDecoder
from toolkit.semantics.options import SemanticLossWeights
from toolkit.splatting.losses.photometric import mean_ssim

# Weight of the loss across the levels of the tree (H-IV.A: omega 2).
INTER_WEIGHT = 5.0


@dataclass(frozen=True)
class SemanticGradient:
    """Semantic loss and the derivative of its sum over pixels.

    Attributes:
        value: mean loss over pixels.
        features: [S, H, W] derivative with respect to the composited features.
        silhouette: [H, W] derivative with respect to the silhouette, or None if the loss is not
            propagated to geometry.
    """

    value: float
    features: Tensor
    silhouette: Tensor | None


class SemanticLoss:
    """Semantic loss of one code and, optionally, the network that decodes it.

    Args:
        code: semantic code of the feature channels.
        weights: weights of the terms.
        network: decoder whose loss is the inter-level term, or None to omit the term.
        seed: random seed of the pixel sampling, combined with the network's step count.
        inter: weight of the inter-level term.
    """

    def __init__(
        self,
        code: SemanticCode,
        weights: SemanticLossWeights,
        network: NetworkDecoder | None = None,
        seed: int = 0,
        inter: float = INTER_WEIGHT,
    ) -> None:
        self.code, self.weights, self.network = code, weights, network
        self._seed, self._inter = seed, inter

    def __call__(
        self,
        features: Tensor,
        silhouette: Tensor,
        labels: Tensor,
        progress: tuple[int, int],
        out: Tensor | None = None,
    ) -> SemanticGradient:
        """Compute the loss of a rendered view.

        Args:
            features: [S, H, W] composited features. silhouette: [H, W].
            labels: [H, W] int32 class ids; pixels with 0 (void) are ignored.
            progress: index of the iteration within the mapping call, from 0, and the number of
                iterations.
            out: [S, H, W] output tensor of the gradient, or None to allocate one.
        """
        weights = self.weights
        gradient = torch.empty_like(features) if out is None else out
        result = self._intra(features, silhouette, labels, gradient)
        step, steps = progress
        if self.network is None or step < min(weights.inter_from, steps // 4):
            return result
        value = result.value + self._add_inter(features, silhouette, labels, result)
        return SemanticGradient(value, result.features, result.silhouette)

    def _intra(
        self, features: Tensor, silhouette: Tensor, labels: Tensor, gradient: Tensor
    ) -> SemanticGradient:
        scale = self.weights.weight
        min_silhouette = self.weights.min_silhouette
        by_silhouette = torch.zeros_like(silhouette) if self.weights.moves_geometry else None
        module = kernels_for(features)
        if module is None or self.code.heads is None:
            images = (features, silhouette, labels)
            found = semantic_loss_torch(self.code, images, self.weights)
            return replace(found, features=gradient.copy_(found.features))
        heads = _scaled(self.code.heads, scale)
        total = module.semantic_loss(
            (features.shape[2], features.shape[1]),
            [address(t) for t in (features, silhouette, labels)],
            len(heads.first),
            [a.ctypes.data for a in (heads.first, heads.width, heads.weight, heads.targets)],
            heads.bits,
            min_silhouette,
            [address(gradient), address(by_silhouette)],
        )
        return SemanticGradient(total / labels.numel(), gradient, by_silhouette)

    def _add_inter(
        self, features: Tensor, silhouette: Tensor, labels: Tensor, result: SemanticGradient
    ) -> float:
        """Add the inter-level term on a stratified sample of pixels."""
        weights, network = self.weights, self.network
        assert network is not None
        valid = (labels > 0) & (silhouette >= weights.min_silhouette)
        pixels = valid.view(-1).nonzero().squeeze(1)
        if len(pixels) == 0:
            return 0.0
        valid_count = len(pixels)
        if weights.inter_pixels and valid_count > weights.inter_pixels:
            stride = valid_count // weights.inter_pixels
            start = torch.arange(weights.inter_pixels) * stride
            generator = np.random.default_rng((self._seed, network.steps))
            jitter = generator.integers(stride, size=weights.inter_pixels)
            pixels = pixels[(start + torch.from_numpy(jitter)).to(pixels.device)]
        sampled_silhouette = silhouette.view(-1)[pixels]
        values = features.view(len(features), -1).index_select(1, pixels) / sampled_silhouette
        value, by_values = network.learn(values, labels.view(-1)[pixels].long())
        scale = weights.weight * self._inter
        # Scale the sample to all valid pixels.
        by_values = by_values * (scale * valid_count / len(pixels))
        result.features.view(len(features), -1)[:, pixels] += by_values / sampled_silhouette
        if result.silhouette is not None:
            result.silhouette.view(-1)[pixels] -= (by_values * values).sum(0) / sampled_silhouette
        return scale * value * valid_count / labels.numel()


def _scaled(heads: Heads, scale: float) -> Heads:
    weight = (heads.weight * scale).astype(np.float32)
    return Heads(heads.first, heads.width, weight, heads.targets, heads.bits)


def semantic_loss_torch(
    code: SemanticCode, images: tuple[Tensor, Tensor, Tensor], weights: SemanticLossWeights
) -> SemanticGradient:
    """Compute the intra-level term by autograd for any code; reference of the native kernel.

    Args:
        images: features [S, H, W], silhouette [H, W] and labels [H, W].
    """
    features, silhouette, labels = images
    valid = (labels > 0) & (silhouette >= weights.min_silhouette)
    pixels = valid.view(-1).nonzero().squeeze(1)
    scale = weights.weight
    structure = weights.structure if code.is_colour else 0.0
    with torch.enable_grad():
        leaves = [features.detach().requires_grad_(), silhouette.detach().requires_grad_()]
        flat = leaves[0].view(len(features), -1).index_select(1, pixels)
        values = flat / leaves[1].view(-1).index_select(0, pixels)
        pixel_scale = scale * (1.0 - structure)
        loss = pixel_scale * code.pixel_loss(values, labels.view(-1)[pixels]).sum()
        if structure > 0:
            safe_silhouette = torch.where(valid, leaves[1], torch.ones_like(silhouette))
            colours = torch.where(valid, leaves[0] / safe_silhouette, torch.zeros_like(features))
            similarity = mean_ssim(colours, _class_colours(code, labels * valid))
            loss = loss + scale * structure * (1.0 - similarity) * labels.numel()
        by_features, by_silhouette = torch.autograd.grad(loss, leaves)
    return SemanticGradient(
        float(loss.detach()) / labels.numel(),
        by_features,
        by_silhouette if weights.moves_geometry else None,
    )


def _class_colours(code: SemanticCode, labels: Tensor) -> Tensor:
    """Return the colours [3, H, W] of class ids [H, W] in a colour code; void is black."""
    codewords = code.codewords.to(labels.device)
    return codewords.index_select(0, labels.reshape(-1).long()).T.reshape(3, *labels.shape)
