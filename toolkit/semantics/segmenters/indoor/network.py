"""A small U-Net that labels the cells of a depth image."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from toolkit.base.errors import FormatError
from toolkit.semantics.segmenters.indoor.channels import COUNT
from toolkit.semantics.segmenters.indoor.classes import INDOOR_CLASSES

# Channels by level: half, quarter, eighth and sixteenth of the resolution of the input.
_WIDTHS = (24, 48, 80, 128)
_FINE = 16
# Size of the input must be a multiple of this.
MULTIPLE = 16


class IndoorNetwork(nn.Module):
    """Logits of classes for each cell.

    Args:
        classes: number of classes, without void.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        first = _WIDTHS[0]
        self.stem = _block(COUNT, first, stride=2)
        self.down = nn.ModuleList(
            nn.Sequential(_block(a, b, stride=2), _Residual(b)) for a, b in pairwise(_WIDTHS)
        )
        self.deep = nn.Sequential(_Residual(_WIDTHS[-1]), _Context(_WIDTHS[-1]))
        self.up = nn.ModuleList(_block(a + b, a) for a, b in pairwise(_WIDTHS))
        self.fine = nn.Sequential(_block(COUNT + first, _FINE), nn.Conv2d(_FINE, _FINE, 1))
        self.head = nn.Conv2d(first, classes, 1)
        self.fine_head = nn.Conv2d(_FINE, classes, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Logits [B, classes, h, w] of channels [B, 8, h, w]; both sides multiples of 16."""
        grown = _grown(self._levels(image)[-1], image)
        fine = self.fine(torch.cat([image, grown], dim=1))
        return torch.as_tensor(self.head(grown) + self.fine_head(fine))

    def columns(self, image: Tensor) -> Tensor:
        """What all levels know of each cell [B, 304, h, w], from which other classes are told."""
        grown = [_grown(level, image) for level in self._levels(image)]
        fine = self.fine[0](torch.cat([image, grown[-1]], dim=1))
        return torch.cat([image, fine, *grown], dim=1)

    def _levels(self, image: Tensor) -> list[Tensor]:
        """The levels with all that is around a cell, from the coarsest to the finest."""
        skipped = [self.stem(image)]
        for step in self.down:
            skipped.append(step(skipped[-1]))
        levels = [self.deep(skipped.pop())]
        for step in reversed(self.up):
            same = skipped.pop()
            levels.append(step(torch.cat([same, _grown(levels[-1], same)], dim=1)))
        return levels


def _grown(coarse: Tensor, image: Tensor) -> Tensor:
    return nn.functional.interpolate(coarse, image.shape[-2:], mode="bilinear")


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    """Two convolutions around which the input is passed."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _block(channels, channels)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, values: Tensor) -> Tensor:
        return torch.relu(values + self.second(self.first(values)))


class _Context(nn.Module):
    """Adds what the whole view contains to each cell: a kitchen, an office, a corridor."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mix = nn.Linear(channels, channels)

    def forward(self, values: Tensor) -> Tensor:
        return values + torch.relu(self.mix(values.mean(dim=(2, 3))))[..., None, None]


_Network = TypeVar("_Network", bound=nn.Module)


@dataclass(frozen=True)
class IndoorWeights:
    """A trained network, and what the room's structure says of its classes.

    Attributes:
        network: with batch normalisation merged into the convolutions.
        structure: [6, C] float32, logarithms of the probability that the geometric segmenter gives
            a cell of a class each of its labels (void, floor, wall, ceiling, surface, object).
        digest: SHA-256 of the file.
    """

    network: IndoorNetwork
    structure: NDArray[np.float32]
    digest: str

    def log_probabilities(self, channels: Tensor) -> Tensor:
        """Log probabilities [C, h, w] of classes, of channels [8, h, w]."""
        return torch.log_softmax(_padded(self.network, channels), dim=0)

    def columns(self, channels: Tensor) -> Tensor:
        """What the network knows of each cell [304, h, w], of channels [8, h, w]."""
        return _padded(self.network.columns, channels)


def _padded(network: Callable[[Tensor], Tensor], channels: Tensor) -> Tensor:
    """The output of the network for channels [8, h, w] of any size."""
    height, width = channels.shape[1:]
    missing = -width % MULTIPLE, -height % MULTIPLE
    image = nn.functional.pad(channels, (0, missing[0], 0, missing[1]))[None]
    out = network(image.contiguous(memory_format=torch.channels_last))
    return out[0, :, :height, :width].contiguous()


def load_weights(path: Path) -> IndoorWeights:
    """Load what `data_tools.train_segmenter` writes.

    Raises:
        FormatError: the file is not one of weights for these classes.
    """
    try:
        with safe_open(path, framework="pt") as file:
            classes = tuple((file.metadata() or {}).get("classes", "").split(","))
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 - not a dict
    except (OSError, SafetensorError) as e:
        raise FormatError(f"{path}: not a file of weights: {e}") from e
    if classes != INDOOR_CLASSES:
        raise FormatError(f"{path}: the weights are of other classes; train them again")
    structure = tensors.pop("structure").numpy()
    # Without random weights, which would advance the generator of the process.
    with torch.device("meta"):
        network = IndoorNetwork(len(INDOOR_CLASSES))
    missing, surplus = network.load_state_dict(tensors, strict=False, assign=True)
    if surplus or any(not name.endswith("num_batches_tracked") for name in missing):
        raise FormatError(f"{path}: the weights are of another network; train them again")
    merged = _merged(network.eval()).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return IndoorWeights(merged.requires_grad_(False), structure, digest)


def shipped_weights() -> IndoorWeights:
    """The weights of the package."""
    with resources.as_file(resources.files(__package__) / "weights.safetensors") as path:
        return load_weights(path)


def _merged(network: _Network) -> _Network:
    """The network with each batch normalisation merged into the convolution before it."""
    for child in network.children():
        parts = list(child.children())
        if (
            len(parts) > 1
            and isinstance(parts[0], nn.Conv2d)
            and isinstance(parts[1], nn.BatchNorm2d)
        ):
            child[0] = fuse_conv_bn_eval(parts[0], parts[1])  # type: ignore[operator]
            child[1] = nn.Identity()  # type: ignore[operator]
        else:
            _merged(child)
    return network
