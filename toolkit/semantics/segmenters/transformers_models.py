"""Semantic segmentation models of the `transformers` library."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.frame import Frame
from toolkit.io.class_names import VOID_NAMES
from toolkit.semantics.features.pretrained.loading import (
    device_of,
    load_image_processor,
    load_model,
)

# Options of image processors that change the field of view; they are disabled.
_CROPS = ("do_center_crop", "do_pad")


class TransformersSegmenter:
    """Labels frames by a model for semantic segmentation.

    Class ids are those of the model plus one, since 0 is void. Classes that the model names void
    become void.

    Args:
        folder: local folder with the model (`AutoModelForSemanticSegmentation`) and its image
            processor.
        min_confidence: minimum probability of the most likely class, 0 to 1; pixels below it are
            void.
        device: "cpu", "cuda", or "auto".

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not available.
        FormatError: the folder is invalid.
    """

    def __init__(self, folder: Path, min_confidence: float = 0.0, device: str = "auto") -> None:
        self._device = device_of(device)
        self._model = load_model("AutoModelForSemanticSegmentation", folder).to(self._device)
        self._processor = load_image_processor(folder)
        self._no_crops = {name: False for name in _CROPS if getattr(self._processor, name, False)}
        self._min_confidence = min_confidence
        names = {int(i): str(name) for i, name in self._model.config.id2label.items()}
        self._count = len(names)
        if sorted(names) != list(range(self._count)):
            raise FormatError(f"{folder}: id2label must number its classes from 0 without gaps")
        void = [True, *(names[i].casefold() in VOID_NAMES for i in range(self._count))]
        self._void = torch.tensor(void, dtype=torch.bool, device=self._device)
        self.place_divergence = 0.4
        self.class_names: Mapping[int, str] = {
            i + 1: name for i, name in names.items() if name.casefold() not in VOID_NAMES
        }
        if not self.class_names:
            raise FormatError(f"{folder}: id2label contains no class other than void")

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Return class ids [H, W], 0 where the confidence is too low."""
        rgb = np.rint(np.clip(frame.rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
        prepared = self._processor(rgb, return_tensors="pt", **self._no_crops)
        with torch.inference_mode():
            logits = self._model(prepared["pixel_values"].to(self._device)).logits
        if logits.shape[1] != self._count:
            raise FormatError(
                f"the model predicts {logits.shape[1]} classes, but config.json names "
                f"{self._count}; correct its id2label"
            )
        labels = confident_labels(logits, frame.depth_m.shape, self._min_confidence)
        labels = torch.where(self._void[labels], 0, labels)
        return labels.to(torch.int32).cpu().numpy()

    def state(self) -> dict[str, NDArray]:
        """Return an empty state: frames are labelled independently."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Accept an earlier `state`, which is empty."""


def confident_labels(
    logits: torch.Tensor, shape: tuple[int, ...], min_confidence: float
) -> torch.Tensor:
    """Return the most likely class plus one [H, W], 0 where its probability is too low.

    Args:
        logits: [1, C, h, w], interpolated to (H, W).
        shape: (H, W).
        min_confidence: minimum probability, 0 to 1.
    """
    with torch.inference_mode():
        full = torch.nn.functional.interpolate(
            logits.float(), size=tuple(shape), mode="bilinear", align_corners=False
        )[0]
        confidence, best = full.softmax(dim=0).max(dim=0)
        return torch.where(confidence >= min_confidence, best + 1, 0)
