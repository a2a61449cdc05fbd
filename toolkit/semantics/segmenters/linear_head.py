"""A linear classifier on patch features: its file, and the segmenter that it makes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import DependencyError, FormatError
from toolkit.frame import Frame
from toolkit.io.atomic import replacing
from toolkit.semantics.segmenters.patch_features import PatchEncoder
from toolkit.semantics.segmenters.transformers_models import confident_labels

_FORMAT = "semsplat-linear-head-1"


@dataclass(frozen=True)
class LinearHead:
    """Class scores = weights @ feature + bias.

    Attributes:
        weights: [C, D] float32.
        bias: [C] float32.
        class_names: C names; class i + 1 is the i-th.
        encoder_digest: which encoder's features it takes (`PatchEncoder.digest`).
        longest_side: at which size (`PatchEncoder.longest_side`).
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
        """Logits [..., C] of features [..., D]."""
        return features @ self.weights.to(features).T + self.bias.to(features)

    def save(self, path: Path) -> None:
        """Write a safetensors file; names and encoder are in its header.

        Raises:
            DependencyError: safetensors is missing.
            RunFolderError: the file cannot be written.
        """
        save_file = _safetensors().save_file
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
        """Read what `save` wrote.

        Raises:
            DependencyError: safetensors is missing.
            FormatError: the file is missing, damaged, or no such head.
        """
        torch_files = _safetensors()
        from safetensors import SafetensorError

        if not path.is_file():
            raise FormatError(f"{path} is not there; train a head with: semsplat train-head")
        try:
            with torch_files.safe_open(path, framework="pt") as file:
                header = file.metadata() or {}
                if header.get("format") != _FORMAT:
                    raise ValueError(f"its format is {header.get('format')!r}, not {_FORMAT!r}")
                weights, bias = file.get_tensor("weights"), file.get_tensor("bias")
            names = tuple(str(name) for name in json.loads(header["classes"]))
            side = int(header["longest_side"])
            return cls(weights.float(), bias.float(), names, header["encoder"], side)
        except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
            raise FormatError(
                f"{path} is no head of semsplat: {error}; train one with: semsplat train-head"
            ) from error


class HeadSegmenter:
    """Labels frames by a linear head on an encoder's patch features.

    Args:
        encoder: of the features, at the head's `longest_side`.
        head: trained on this very encoder.
        min_confidence: probability of the likeliest class, 0 to 1, below which a pixel is
            void.

    Raises:
        FormatError: the head was trained on another encoder.
        ValueError: or at another size.
    """

    def __init__(
        self, encoder: PatchEncoder, head: LinearHead, min_confidence: float = 0.0
    ) -> None:
        if head.encoder_digest != encoder.digest:
            raise FormatError(
                "the head was trained on another encoder (model folder); give that one, or "
                "train a head for this one with: semsplat train-head"
            )
        if head.longest_side != encoder.longest_side:
            raise ValueError(
                f"the encoder must see {head.longest_side} pixels, got {encoder.longest_side}"
            )
        self._encoder, self._head = encoder, head
        self._min_confidence = min_confidence
        self.place_divergence = 0.4
        self.class_names: Mapping[int, str] = dict(enumerate(head.class_names, start=1))

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Class ids [H, W], 0 where the head is not sure enough."""
        logits = self._head.scores(self._encoder.features(frame.rgb)).permute(2, 0, 1)[None]
        labels = confident_labels(logits, frame.depth_m.shape, self._min_confidence)
        return labels.to(torch.int32).cpu().numpy()

    def state(self) -> dict[str, NDArray]:
        """Nothing: every frame stands for itself."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take over an earlier `state`, which is empty."""


def _safetensors() -> ModuleType:
    try:
        import safetensors.torch
    except ImportError as error:
        raise DependencyError(
            f"safetensors cannot be loaded ({error}); fix it with: pip install "
            "'semsplat[semantics]'"
        ) from error
    return safetensors.torch
