"""Codes that represent classes by a few channels, which the renderer can blend (H-7, H-8).

Flat, one-hot and binary codes consist of groups of channels ("heads"). Each head predicts one
attribute of the class, such as its node at one level of the tree, and blended values are
interpreted as logits. The likelihood of a path is the product over its heads. Up to a constant, its
logarithm is linear in the values, `logits = codewords @ values`. It is evaluated for valid classes
only, so invalid paths are never decoded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.semantics.options import CodeOptions
from toolkit.semantics.taxonomy import Taxonomy

_MIN_LOGIT = 0.5
# Probability of the observed class in the code of a new Gaussian.
_START_CONFIDENCE = 0.9
_MIN_COLOUR = 0.1
_SPREAD = 0.05  # standard deviation of the colours of a class in the decoder
_PRIOR = 0.1  # pseudo-count of votes, in pixels, for every possible value of a head


class SemanticCode(Protocol):
    """Encodes classes as feature channels of Gaussians and decodes them.

    Attributes:
        name: name in the options.
        taxonomy: tree of classes; ids start at 1, 0 is void.
        channels: number of feature channels S of a Gaussian.
        heads: description of the heads for the native loss, or None if only `pixel_loss` applies.
        is_colour: whether the values are colours that are compared with those of the classes, so
            that SSIM applies.
        unit: scale of a feature; the learning rate is multiplied by it.
        random_start: new Gaussians have standard normal values instead of `start_values`.
    """

    name: str
    taxonomy: Taxonomy
    channels: int
    unit: float
    heads: Heads | None
    is_colour: bool
    random_start: bool

    @property
    def start_values(self) -> Tensor:
        """Initial values [C + 1, S] of a new Gaussian by class id; row 0 is void."""
        ...

    @property
    def codewords(self) -> Tensor:
        """Codewords [C + 1, S], the votes of a pixel, by class id; row 0 (void) is zero."""
        ...

    def from_votes(self, votes: Tensor, total: Tensor) -> Tensor:
        """Return values [N, S] fitted to the labels of the pixels that Gaussians contribute to.

        Args:
            votes: [N, S] sum of the pixels' codewords, weighted by the Gaussian's blending weight.
            total: [N] sum of the blending weights of labelled pixels.
        """
        ...

    def is_labelled(self, values: Tensor) -> Tensor:
        """Return the mask [P] of values [S, P] that represent a class; void values stay near 0."""
        ...

    def logits(self, values: Tensor) -> Tensor:
        """Return the log-likelihood [C, P] of the classes for values [S, P], up to a constant."""
        ...

    def pixel_loss(self, values: Tensor, class_ids: Tensor) -> Tensor:
        """Return the differentiable loss [P] of values [S, P] for class ids [P] > 0."""
        ...


@dataclass(frozen=True)
class Heads:
    """K groups of channels, each with a target per class.

    Attributes:
        first, width: [K] int32, first channel and number of channels of each head.
        weight: [K] float32, weight of the head in the loss.
        targets: [C, K] int32, target channel of the head; for `bits`, the binary number whose
            lowest bit is the first channel.
        bits: one sigmoid per channel (H-11) instead of one softmax per head (H-10).
    """

    first: NDArray[np.int32]
    width: NDArray[np.int32]
    weight: NDArray[np.float32]
    targets: NDArray[np.int32]
    bits: bool


class HeadedCode:
    """Flat, one-hot and binary codes.

    Args:
        name: name of the code.
        taxonomy: tree of classes.
        head_values: value of each head for each class, [C, K], and the number of possible values
            of each head, [K], at least 2.
        bits: encode the values in binary.
        options: normalisation of the loss and initial values.
    """

    is_colour = False

    def __init__(
        self,
        name: str,
        taxonomy: Taxonomy,
        head_values: tuple[NDArray[np.int32], NDArray[np.int32]],
        bits: bool,
        options: CodeOptions | None = None,
    ) -> None:
        options = options or CodeOptions()
        targets, counts = head_values
        self.name, self.taxonomy, self.unit = name, taxonomy, 1.0
        self.random_start = options.start == "random"
        width = np.ceil(np.log2(counts)).astype(np.int32) if bits else counts.astype(np.int32)
        uniform_loss = width * math.log(2.0) if bits else np.log(counts)
        weight = 1.0 / uniform_loss if options.normalise else np.ones(len(counts))
        first = (np.cumsum(width) - width).astype(np.int32)
        self.channels = int(width.sum())
        self.heads: Heads | None = Heads(
            first, width, weight.astype(np.float32), np.ascontiguousarray(targets), bits
        )
        self._class_codewords = torch.from_numpy(self._codewords())
        self._start = self._start_values(_START_CONFIDENCE)

    @property
    def start_values(self) -> Tensor:
        """See SemanticCode."""
        return self._start

    @property
    def codewords(self) -> Tensor:
        """See SemanticCode."""
        return torch.cat([self._class_codewords.new_zeros(1, self.channels), self._class_codewords])

    def from_votes(self, votes: Tensor, total: Tensor) -> Tensor:
        """See SemanticCode: logarithms of the fraction of votes of each value of a head.

        They minimise the loss of a single Gaussian (H-10, H-11). A pseudo-count is added to every
        value, otherwise a single vote would give infinite logits.
        """
        heads = self.heads
        assert heads is not None
        if heads.bits:
            against = (total[:, None] - votes).clamp(min=0.0)
            return ((votes + _PRIOR) / (against + _PRIOR)).log()
        width = torch.from_numpy(np.repeat(heads.width, heads.width)).to(votes)
        return ((votes * width + _PRIOR) / (total[:, None] + _PRIOR)).log()

    def is_labelled(self, values: Tensor) -> Tensor:
        """See SemanticCode: at least one logit is large enough."""
        return values.abs().amax(dim=0) > _MIN_LOGIT

    def logits(self, values: Tensor) -> Tensor:
        """See SemanticCode: the normalisation of the heads is the same for all classes."""
        return self._class_codewords.to(values) @ values

    def pixel_loss(self, values: Tensor, class_ids: Tensor) -> Tensor:
        """See SemanticCode (H-10, H-11); reference implementation of the native kernel."""
        heads = self.heads
        assert heads is not None
        total = values.new_zeros(values.shape[1])
        for k, (first, width) in enumerate(zip(heads.first, heads.width, strict=True)):
            part = values[first : first + width]
            target = torch.from_numpy(heads.targets[:, k]).to(values.device)[class_ids - 1].long()
            if heads.bits:
                target_bits = (
                    target[None] >> torch.arange(int(width), device=target.device)[:, None]
                ) & 1
                loss = torch.nn.functional.binary_cross_entropy_with_logits(
                    part, target_bits.to(part), reduction="none"
                ).sum(0)
            else:
                loss = torch.nn.functional.cross_entropy(part.T, target, reduction="none")
            total = total + float(heads.weight[k]) * loss
        return total

    def _codewords(self) -> NDArray[np.float32]:
        """Return the codeword of each class, [C, S] of 0 and 1."""
        heads = self.heads
        assert heads is not None
        codewords = np.zeros((len(self.taxonomy), self.channels), np.float32)
        for k, (first, width) in enumerate(zip(heads.first, heads.width, strict=True)):
            target = heads.targets[:, k]
            if heads.bits:
                codewords[:, first : first + width] = (target[:, None] >> np.arange(width)) & 1
            else:
                codewords[np.arange(len(codewords)), first + target] = 1.0
        return codewords

    def _start_values(self, confidence: float) -> Tensor:
        """Return logits that give every head the same confidence for any width."""
        heads = self.heads
        assert heads is not None
        odds = math.log(confidence / (1.0 - confidence))
        if heads.bits:
            values = (2.0 * self._class_codewords - 1.0) * odds
        else:
            height = odds + np.log(heads.width.astype(np.float32) - 1.0)
            values = (
                self._class_codewords * torch.from_numpy(np.repeat(height, heads.width)).float()
            )
        return torch.cat([values.new_zeros(1, self.channels), values])


def flat_code(taxonomy: Taxonomy, options: CodeOptions | None = None) -> HeadedCode:
    """Build a code with one channel per class."""
    targets = np.arange(len(taxonomy), dtype=np.int32)[:, None]
    head_values = targets, np.array([len(taxonomy)], np.int32)
    return HeadedCode("flat", taxonomy, head_values, False, options)


def one_hot_code(taxonomy: Taxonomy, options: CodeOptions | None = None) -> HeadedCode:
    """Build a code with one channel per sibling at each level (H-7)."""
    return HeadedCode("one-hot", taxonomy, _levels(taxonomy), False, options)


def binary_code(taxonomy: Taxonomy, options: CodeOptions | None = None) -> HeadedCode:
    """Build a code with the binary number of the sibling at each level (H-8)."""
    return HeadedCode("binary", taxonomy, _levels(taxonomy), True, options)


def _levels(taxonomy: Taxonomy) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return local ids and widths of the levels with more than one sibling."""
    widths = np.array(taxonomy.level_widths, np.int32)
    return taxonomy.local_ids[:, widths > 1], widths[widths > 1]


class ColourCode:
    """Three channels with the class's colour in a palette, decoded to the nearest colour (G).

    Args:
        taxonomy: tree of classes.
        palette: [C, 3] distinct colours in [0, 1].
    """

    heads: Heads | None = None
    is_colour = True
    random_start = False

    def __init__(self, taxonomy: Taxonomy, palette: NDArray[np.float32]) -> None:
        if palette.shape != (len(taxonomy), 3):
            raise ValueError(
                f"palette must have shape [{len(taxonomy)}, 3], got {list(palette.shape)}"
            )
        self.name, self.taxonomy, self.channels = "colour", taxonomy, 3
        self._palette = torch.from_numpy(np.asarray(palette, np.float32))
        self._precision = 1.0 / _SPREAD**2
        self.unit = 0.2 * _SPREAD

    @property
    def start_values(self) -> Tensor:
        """See SemanticCode."""
        return torch.cat([self._palette.new_zeros(1, 3), self._palette])

    @property
    def codewords(self) -> Tensor:
        """See SemanticCode."""
        return self.start_values

    def from_votes(self, votes: Tensor, total: Tensor) -> Tensor:
        """See SemanticCode: the mean colour."""
        return votes / total[:, None].clamp(min=1e-6)

    def is_labelled(self, values: Tensor) -> Tensor:
        """See SemanticCode: the colour is not black."""
        return values.amax(dim=0) > _MIN_COLOUR

    def logits(self, values: Tensor) -> Tensor:
        """See SemanticCode: a normal distribution around each colour of the palette."""
        palette = self._palette.to(values)
        return self._precision * (palette @ values - 0.5 * (palette**2).sum(1, keepdim=True))

    def pixel_loss(self, values: Tensor, class_ids: Tensor) -> Tensor:
        """Return the mean absolute difference from the class's colour (G-3)."""
        return (values - self._palette.to(values)[class_ids - 1].T).abs().mean(0)
