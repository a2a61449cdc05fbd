"""Semantic segmentation heads of the `transformers` library."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.frame import Frame
from toolkit.io.class_names import VOID_NAMES
from toolkit.pretrained.loading import device_of, load_image_processor, load_model

# What would make the picture that the model sees another one than the frame.
_CROPS = ("do_center_crop", "do_pad")


class TransformersSegmenter:
    """Labels frames by a model for semantic segmentation.

    Ids are the model's own plus one, since 0 is void here; classes that the model itself
    calls void become void.

    Args:
        folder: a local folder with the model (`AutoModelForSemanticSegmentation`) and its
            image processor.
        min_confidence: probability of the likeliest class, 0 to 1, below which a pixel is
            void.
        device: "cpu", "cuda", or "auto".

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not there.
        FormatError: the folder is not what it should be.
    """

    def __init__(self, folder: Path, min_confidence: float = 0.0, device: str = "auto") -> None:
        self._device = device_of(device)
        self._model = load_model("AutoModelForSemanticSegmentation", folder).to(self._device)
        self._processor = load_image_processor(folder)
        self._whole = {name: False for name in _CROPS if getattr(self._processor, name, False)}
        self._min_confidence = min_confidence
        names = {int(i): str(name) for i, name in self._model.config.id2label.items()}
        self._count = len(names)
        if sorted(names) != list(range(self._count)):
            raise FormatError(f"{folder}: id2label must number its classes from 0 without gaps")
        void = [True, *(names[i].casefold() in VOID_NAMES for i in range(self._count))]
        self._void = torch.tensor(void, device=self._device)
        self.place_divergence = 0.4
        self.class_names: Mapping[int, str] = {
            i + 1: name for i, name in names.items() if name.casefold() not in VOID_NAMES
        }
        if not self.class_names:
            raise FormatError(f"{folder}: id2label names no class")

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Class ids [H, W], 0 where the model is not sure enough."""
        rgb = np.rint(np.clip(frame.rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
        prepared = self._processor(rgb, return_tensors="pt", **self._whole)
        with torch.inference_mode():
            logits = self._model(prepared["pixel_values"].to(self._device)).logits
        if logits.shape[1] != self._count:
            raise FormatError(
                f"the model scores {logits.shape[1]} classes, but config.json names {self._count}; "
                "correct its id2label"
            )
        labels = confident_labels(logits, frame.depth_m.shape, self._min_confidence)
        labels = torch.where(self._void[labels], 0, labels)
        return labels.to(torch.int32).cpu().numpy()

    def state(self) -> dict[str, NDArray]:
        """Nothing: every frame stands for itself."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take over an earlier `state`, which is empty."""


def confident_labels(
    logits: torch.Tensor, shape: tuple[int, ...], min_confidence: float
) -> torch.Tensor:
    """The likeliest class plus one [H, W], 0 where its probability is too small.

    Args:
        logits: [1, C, h, w], enlarged to (H, W) before anything is decided.
        shape: (H, W).
        min_confidence: 0 to 1.
    """
    with torch.inference_mode():
        full = torch.nn.functional.interpolate(
            logits.float(), size=tuple(shape), mode="bilinear", align_corners=False
        )[0]
        confidence, best = full.softmax(dim=0).max(dim=0)
        return torch.where(confidence >= min_confidence, best + 1, 0)
