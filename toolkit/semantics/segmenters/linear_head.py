"""A linear classifier on patch features, its file format, and the segmenter that applies it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from toolkit.base.errors import FormatError
from toolkit.base.frame import Frame
from toolkit.io.atomic import replacing
from toolkit.io.guarded.content import check_regular
from toolkit.io.guarded.documents import parse_json
from toolkit.semantics.segmenters.transformers_models import confident_labels

_FORMAT = "semsplat-linear-head-1"
_MAX_BYTES = 2**30


class Encoder(Protocol):
    """Computes a feature vector for each patch of a frame."""

    @property
    def longest_side(self) -> int:
        """Longest side of the input in pixels."""

    @property
    def digest(self) -> str:
        """SHA-256 of the weights; identifies the encoder that a head was trained on."""

    def features(self, frame: Frame) -> torch.Tensor:
        """Return the features [rows, columns, D] float32 of the patches of a frame."""


@dataclass(frozen=True)
class LinearHead:
    """Class scores = weights @ feature + bias.

    Attributes:
        weights: [C, D] float32.
        bias: [C] float32.
        class_names: C names; the i-th (from 0) is that of class id i + 1.
        encoder_digest: digest of the encoder (`Encoder.digest`).
        longest_side: image size of the encoder in pixels (`Encoder.longest_side`).
    """

    weights: torch.Tensor
    bias: torch.Tensor
    class_names: tuple[str, ...]
    encoder_digest: str
    longest_side: int

    def __post_init__(self) -> None:
        count = len(self.class_names)
        if count < 1 or self.weights.ndim != 2 or self.weights.shape[0] != count:
            raise ValueError(
                f"weights must have shape [{count}, D], got {list(self.weights.shape)}"
            )
        if self.bias.shape != (count,):
            raise ValueError(f"bias must have shape [{count}], got {list(self.bias.shape)}")

    def scores(self, features: torch.Tensor) -> torch.Tensor:
        """Return the logits [..., C] of features [..., D]."""
        return features @ self.weights.to(features).T + self.bias.to(features)

    def save(self, path: Path) -> None:
        """Write a safetensors file with the names and the encoder in its header.

        Raises:
            RunFolderError: the file cannot be written.
        """
        header = {
            "format": _FORMAT,
            "classes": json.dumps(self.class_names),
            "encoder": self.encoder_digest,
            "longest_side": str(self.longest_side),
        }
        with replacing(path) as temporary:
            save_file({"weights": self.weights, "bias": self.bias}, temporary, metadata=header)

    @classmethod
    def load(cls, path: Path) -> LinearHead:
        """Read a file written by `save`.

        Raises:
            FormatError: the file is missing, damaged, or not a head.
        """
        if not path.is_file():
            raise FormatError(f"{path} does not exist; train a head with: semsplat train-head")
        try:
            check_regular(path, _MAX_BYTES)
            with safe_open(path, framework="pt") as file:
                header = file.metadata() or {}
                if header.get("format") != _FORMAT:
                    raise ValueError(f"the format is {header.get('format')!r}, not {_FORMAT!r}")
                weights, bias = file.get_tensor("weights"), file.get_tensor("bias")
            names = tuple(str(name) for name in parse_json(header["classes"]))
            side = int(header["longest_side"])
            return cls(weights.float(), bias.float(), names, header["encoder"], side)
        except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
            raise FormatError(
                f"{path} is not a semsplat head: {error}; train one with: semsplat train-head"
            ) from error


class HeadSegmenter:
    """Labels frames by a linear head on an encoder's patch features.

    Args:
        encoder: computes the features, at the head's `longest_side`.
        head: head trained on this encoder.
        min_confidence: minimum probability of the most likely class, 0 to 1; pixels below it are
            void.

    Raises:
        FormatError: the head was trained on another encoder.
        ValueError: the head was trained at another image size.
    """

    def __init__(self, encoder: Encoder, head: LinearHead, min_confidence: float = 0.0) -> None:
        if head.encoder_digest != encoder.digest:
            raise FormatError(
                "the head was trained on another encoder (model folder, or version of the indoor "
                "network); set the folder of that encoder, or train a head for this one with: "
                "semsplat train-head"
            )
        if head.longest_side != encoder.longest_side:
            raise ValueError(
                f"longest_side of the encoder must be {head.longest_side} pixels, got "
                f"{encoder.longest_side}"
            )
        self._encoder, self._head = encoder, head
        self._min_confidence = min_confidence
        self.place_divergence = 0.4
        self.class_names: Mapping[int, str] = dict(enumerate(head.class_names, start=1))

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Return class ids [H, W], 0 where the confidence is too low."""
        logits = self._head.scores(self._encoder.features(frame)).permute(2, 0, 1)[None]
        labels = confident_labels(logits, frame.depth_m.shape, self._min_confidence)
        return labels.to(torch.int32).cpu().numpy()

    def state(self) -> dict[str, NDArray]:
        """Return an empty state: frames are labelled independently."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Accept an earlier `state`, which is empty."""
