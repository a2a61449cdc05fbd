"""LPIPS: learned perceptual image patch similarity (Zhang et al. 2018), AlexNet, version 0.1.

The network is implemented here because the `lpips` package needs torchvision. Its weights are
read from local files: torchvision's AlexNet (`alexnet-owt-7be5be79.pth`) together with the linear
weights of the `lpips` package (`lpips/weights/v0.1/alex.pth`), or one file with all of them.
"""

from __future__ import annotations

import pickle  # noqa: TID251 - only for the error that torch.load raises; nothing is unpickled
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from toolkit.base.errors import FormatError
from toolkit.io.guarded.content import DamagedError, check_regular

# The output of AlexNet's second pooling layer is empty for smaller images.
MIN_SIDE = 31

_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10
# AlexNet has 240 MB.
_MAX_BYTES = 2**30
_POOL_SIZE, _POOL_STRIDE = 3, 2


@dataclass(frozen=True)
class _Layer:
    """A convolution of AlexNet, by its index in torchvision's `features`."""

    index: int
    shape: tuple[int, int, int, int]
    stride: int
    padding: int
    pooled_input: bool


_LAYERS = (
    _Layer(0, (64, 3, 11, 11), 4, 2, False),
    _Layer(3, (192, 64, 5, 5), 1, 2, True),
    _Layer(6, (384, 192, 3, 3), 1, 1, True),
    _Layer(8, (256, 384, 3, 3), 1, 1, False),
    _Layer(10, (256, 256, 3, 3), 1, 1, False),
)

# Names of the same parameters in torchvision's AlexNet, in a complete `lpips.LPIPS` module and in
# the files of its linear weights.
_CONVOLUTION = re.compile(r"(?:net\.)?(?:features|slice\d)\.(\d+)\.(weight|bias)")
_HEAD = re.compile(r"lin(?:s\.)?(\d)\.model\.\d\.weight")

_REMEDY = (
    "give torchvision's alexnet-owt-7be5be79.pth and the lpips package's weights/v0.1/alex.pth, "
    "or one file that holds both"
)


class Lpips:
    """Perceptual distance between two images; 0 for identical images.

    Args:
        weights: parameters by name: `features.INDEX.weight` and `.bias` of the convolutions,
            `lin.LEVEL` of the five linear heads, each [1, C, 1, 1].
        origin: files of the weights, for error messages.

    Raises:
        FormatError: a parameter is missing or has the wrong shape.
    """

    def __init__(self, weights: Mapping[str, Tensor], origin: str = "LPIPS weights") -> None:
        shapes: dict[str, tuple[int, ...]] = {}
        for level, layer in enumerate(_LAYERS):
            shapes[f"features.{layer.index}.weight"] = layer.shape
            shapes[f"features.{layer.index}.bias"] = layer.shape[:1]
            shapes[f"lin.{level}"] = (1, layer.shape[0], 1, 1)
        for name, shape in shapes.items():
            if name not in weights:
                raise FormatError(f"{origin}: {name} is missing; {_REMEDY}")
            if tuple(weights[name].shape) != shape:
                raise FormatError(
                    f"{origin}: {name} must have shape {list(shape)}, got "
                    f"{list(weights[name].shape)}; {_REMEDY}"
                )
        self._weights = {name: weights[name].detach().float() for name in shapes}

    @classmethod
    def load(cls, paths: Sequence[Path]) -> Lpips:
        """Read weights from .safetensors files or state dicts written by `torch.save`.

        Raises:
            FormatError: a file is missing, damaged or contains other objects than tensors, or
                no file contains one of the parameters.
        """
        weights: dict[str, Tensor] = {}
        for path in paths:
            for name, tensor in _read(path).items():
                if match := _CONVOLUTION.fullmatch(name):
                    weights[f"features.{match[1]}.{match[2]}"] = tensor
                elif match := _HEAD.fullmatch(name):
                    weights[f"lin.{match[1]}"] = tensor
        return cls(weights, ", ".join(str(path) for path in paths))

    def __call__(self, rendered: NDArray[np.floating], truth: NDArray[np.floating]) -> float | None:
        """Compute the distance of two images [H, W, 3] in [0, 1].

        Returns:
            The distance; None if a side is shorter than 31 pixels.
        """
        if min(rendered.shape[:2]) < MIN_SIDE:
            return None
        with torch.no_grad():
            levels = self._activations(np.stack([rendered, truth]))
            distances = [
                functional.conv2d((a[:1] - a[1:]) ** 2, self._weights[f"lin.{level}"]).mean()
                for level, a in enumerate(levels)
            ]
        return float(torch.stack(distances).sum())

    def _activations(self, images: NDArray[np.floating]) -> list[Tensor]:
        """Return activations [2, C, H, W] of the five layers, normalised at each pixel."""
        x = torch.from_numpy(images.astype(np.float32)).clamp(0.0, 1.0).permute(0, 3, 1, 2)
        x = (2.0 * x - 1.0 - _channels(_SHIFT)) / _channels(_SCALE)
        levels = []
        for layer in _LAYERS:
            if layer.pooled_input:
                x = functional.max_pool2d(x, _POOL_SIZE, _POOL_STRIDE)
            weight, bias = (
                self._weights[f"features.{layer.index}.{k}"] for k in ("weight", "bias")
            )
            x = functional.conv2d(x, weight, bias, layer.stride, layer.padding).relu()
            levels.append(x / (x.square().sum(1, keepdim=True).sqrt() + _EPSILON))
        return levels


def _channels(values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float32).reshape(1, 3, 1, 1)


# Exceptions raised by torch.load for files that are not PyTorch files.
_UNREADABLE = (
    *(OSError, RuntimeError, EOFError, LookupError, ValueError),
    pickle.UnpicklingError,
)


def _read(path: Path) -> Mapping[str, Tensor]:
    """Read the tensors of a file by name."""
    if not path.is_file():
        raise FormatError(f"LPIPS weights {path} do not exist; {_REMEDY}")
    try:
        check_regular(path, _MAX_BYTES)
    except DamagedError as error:
        raise FormatError(f"{path} cannot be read ({error}); {_REMEDY}") from error
    if path.suffix == ".safetensors":
        return _read_safetensors(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        raise FormatError(
            f"{path} cannot be read as a PyTorch state dict ({_first_line(error)}); {_REMEDY}"
        ) from error
    if not isinstance(content, Mapping) or not all(isinstance(v, Tensor) for v in content.values()):
        raise FormatError(f"{path} is not a PyTorch state dict; {_REMEDY}")
    return content


def _read_safetensors(path: Path) -> Mapping[str, Tensor]:
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise FormatError(
            f"{path} cannot be read as safetensors ({_first_line(error)}); {_REMEDY}"
        ) from error


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
