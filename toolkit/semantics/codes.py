"""How a class becomes a few numbers that a renderer can blend (H-7, H-8).

Flat, one-hot and binary codes are one thing: groups of channels ("heads"), each of which
asks one question about the class. Blended values are read as logits. The likelihood of a
whole path is the product over its heads, and all that depends on the class in its logarithm
is linear in the values: `logits = weights @ values + offsets`, over the valid classes alone,
so that a path which no class has can never come out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.semantics.options import CodeOptions
from toolkit.semantics.taxonomy import Taxonomy

_LEAST_LOGIT = 0.5
_LEAST_COLOUR = 0.1
_PRIOR = 0.1  # pixels that vote for every answer alike

CodeName = Literal["flat", "one-hot", "binary", "colour"]


class SemanticCode(Protocol):
    """Numbers for classes, and back.

    Attributes:
        name: as in the settings.
        taxonomy: its classes; ids count from 1, 0 is void.
        channels: S, feature channels of a Gaussian.
        heads: what the native loss needs, or None where only `pixel_loss` will do.
        is_colour: the values are a colour, which is compared with that of the class: SSIM applies.
        unit: what counts as a step of a feature: learning rates are in units of it.
    """

    name: str
    taxonomy: Taxonomy
    channels: int
    unit: float
    heads: Heads | None
    is_colour: bool

    @property
    def start_values(self) -> Tensor:
        """Values [C + 1, S] of a Gaussian seeded from a pixel, by class id; void is row 0."""
        ...

    @property
    def codewords(self) -> Tensor:
        """What a pixel of each class votes for, [C + 1, S] by class id; void is 0."""
        ...

    def from_votes(self, votes: Tensor, total: Tensor) -> Tensor:
        """Values [N, S] that fit the pixels which a Gaussian shows.

        Args:
            votes: [N, S] sum of the pixels' codewords, each times the Gaussian's share in it.
            total: [N] sum of these shares, 0 where there was no label.
        """
        ...

    def is_labelled(self, values: Tensor) -> Tensor:
        """Where values [S, P] say anything at all, [P]: void started, and stayed, at zero."""
        ...

    def logits(self, values: Tensor) -> Tensor:
        """Logarithm of the classes' likelihood [C, P], up to a constant, of values [S, P]."""
        ...

    def pixel_loss(self, values: Tensor, class_ids: Tensor) -> Tensor:
        """Loss [P] of values [S, P] against class ids [P] > 0; differentiable."""
        ...


@dataclass(frozen=True)
class Heads:
    """K groups of channels, each with a target per class.

    Attributes:
        first, width: [K] int32, the channels of a head.
        weight: [K] float32 of its loss.
        targets: [C, K] int32: a channel of the head; for bits, the number they spell, lowest
            bit first.
        bits: a sigmoid per channel (H-11) instead of a softmax per head (H-10).
    """

    first: NDArray[np.int32]
    width: NDArray[np.int32]
    weight: NDArray[np.float32]
    targets: NDArray[np.int32]
    bits: bool


class HeadedCode:
    """Flat, one-hot and binary codes.

    Args:
        name: of the code.
        taxonomy: its classes.
        questions: what each head asks of each class, [C, K], and the number of answers that
            each head has, [K], at least 2.
        bits: spell the answers in binary.
    """

    is_colour = False

    def __init__(
        self,
        name: str,
        taxonomy: Taxonomy,
        questions: tuple[NDArray[np.int32], NDArray[np.int32]],
        bits: bool,
        options: CodeOptions | None = None,
    ) -> None:
        options = options or CodeOptions()
        targets, choices = questions
        self.name, self.taxonomy, self.unit = name, taxonomy, 1.0
        width = np.ceil(np.log2(choices)).astype(np.int32) if bits else choices.astype(np.int32)
        guess = width * math.log(2.0) if bits else np.log(choices)
        weight = 1.0 / guess if options.normalise else np.ones(len(choices))
        first = (np.cumsum(width) - width).astype(np.int32)
        self.channels = int(width.sum())
        self.heads: Heads | None = Heads(
            first, width, weight.astype(np.float32), np.ascontiguousarray(targets), bits
        )
        self._ones = torch.from_numpy(self._codewords())
        self._start = self._start_values(options.start_confidence)

    @property
    def start_values(self) -> Tensor:
        """See SemanticCode."""
        return self._start

    @property
    def codewords(self) -> Tensor:
        """See SemanticCode."""
        return torch.cat([self._ones.new_zeros(1, self.channels), self._ones])

    def from_votes(self, votes: Tensor, total: Tensor) -> Tensor:
        """See SemanticCode: logarithms of each answer's share of the votes.

        For one Gaussian alone they minimise the loss (H-10, H-11). A little of a pixel is
        added to every answer, or one vote would be certainty.
        """
        heads = self.heads
        assert heads is not None
        if heads.bits:
            against = (total[:, None] - votes).clamp(min=0.0)
            return ((votes + _PRIOR) / (against + _PRIOR)).log()
        width = torch.from_numpy(np.repeat(heads.width, heads.width)).to(votes)
        return ((votes * width + _PRIOR) / (total[:, None] + _PRIOR)).log()

    def is_labelled(self, values: Tensor) -> Tensor:
        """See SemanticCode: some head leans somewhere."""
        return values.abs().amax(dim=0) > _LEAST_LOGIT

    def logits(self, values: Tensor) -> Tensor:
        """See SemanticCode: the heads' normalisers are the same for all classes."""
        return self._ones.to(values) @ values

    def pixel_loss(self, values: Tensor, class_ids: Tensor) -> Tensor:
        """See SemanticCode (H-10, H-11); the reference of the native kernel."""
        heads = self.heads
        assert heads is not None
        total = values.new_zeros(values.shape[1])
        for k, (first, width) in enumerate(zip(heads.first, heads.width, strict=True)):
            part = values[first : first + width]
            target = torch.from_numpy(heads.targets[:, k]).to(values.device)[class_ids - 1].long()
            if heads.bits:
                wanted = (
                    target[None] >> torch.arange(int(width), device=target.device)[:, None]
                ) & 1
                loss = torch.nn.functional.binary_cross_entropy_with_logits(
                    part, wanted.to(part), reduction="none"
                ).sum(0)
            else:
                loss = torch.nn.functional.cross_entropy(part.T, target, reduction="none")
            total = total + float(heads.weight[k]) * loss
        return total

    def _codewords(self) -> NDArray[np.float32]:
        """What each class lights up, [C, S] of 0 and 1."""
        heads = self.heads
        assert heads is not None
        words = np.zeros((len(self.taxonomy), self.channels), np.float32)
        for k, (first, width) in enumerate(zip(heads.first, heads.width, strict=True)):
            target = heads.targets[:, k]
            if heads.bits:
                words[:, first : first + width] = (target[:, None] >> np.arange(width)) & 1
            else:
                words[np.arange(len(words)), first + target] = 1.0
        return words

    def _start_values(self, confidence: float) -> Tensor:
        """Logits that give every head the same confidence, whatever its width."""
        heads = self.heads
        assert heads is not None
        odds = math.log(confidence / (1.0 - confidence))
        if heads.bits:
            values = (2.0 * self._ones - 1.0) * odds
        else:
            height = odds + np.log(heads.width.astype(np.float32) - 1.0)
            values = self._ones * torch.from_numpy(np.repeat(height, heads.width)).float()
        return torch.cat([values.new_zeros(1, self.channels), values])


def flat_code(taxonomy: Taxonomy, options: CodeOptions | None = None) -> HeadedCode:
    """One channel a class."""
    targets = np.arange(len(taxonomy), dtype=np.int32)[:, None]
    questions = targets, np.array([len(taxonomy)], np.int32)
    return HeadedCode("flat", taxonomy, questions, False, options)


def one_hot_code(taxonomy: Taxonomy, options: CodeOptions | None = None) -> HeadedCode:
    """At each level one channel a sibling (H-7)."""
    return HeadedCode("one-hot", taxonomy, _levels(taxonomy), False, options)


def binary_code(taxonomy: Taxonomy, options: CodeOptions | None = None) -> HeadedCode:
    """At each level the sibling's number in binary (H-8)."""
    return HeadedCode("binary", taxonomy, _levels(taxonomy), True, options)


def _levels(taxonomy: Taxonomy) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Local ids and widths of the levels that ask anything."""
    widths = np.array(taxonomy.level_widths, np.int32)
    return taxonomy.local_ids[:, widths > 1], widths[widths > 1]


class ColourCode:
    """Three channels: the class's colour in a palette, read as the nearest one (G).

    Args:
        palette: [C, 3] colours in [0, 1], all different.
        spread: standard deviation of a colour that still means its class.
    """

    heads: Heads | None = None
    is_colour = True

    def __init__(
        self, taxonomy: Taxonomy, palette: NDArray[np.float32], spread: float = 0.05
    ) -> None:
        if palette.shape != (len(taxonomy), 3):
            raise ValueError(
                f"palette must have shape [{len(taxonomy)}, 3], got {list(palette.shape)}"
            )
        self.name, self.taxonomy, self.channels = "colour", taxonomy, 3
        self._palette = torch.from_numpy(np.asarray(palette, np.float32))
        self._precision = 1.0 / spread**2
        self.unit = 0.2 * spread

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
        """See SemanticCode: it is not black."""
        return values.amax(dim=0) > _LEAST_COLOUR

    def logits(self, values: Tensor) -> Tensor:
        """See SemanticCode: a Gaussian around each colour of the palette."""
        palette = self._palette.to(values)
        return self._precision * (palette @ values - 0.5 * (palette**2).sum(1, keepdim=True))

    def pixel_loss(self, values: Tensor, class_ids: Tensor) -> Tensor:
        """Mean absolute difference from the class's colour (G-3)."""
        return (values - self._palette.to(values)[class_ids - 1].T).abs().mean(0)
