"""SAM 2: masks of everything in an image, from a grid of points (Ravi et al., 2024).

As in the automatic mask generator of SAM, each point yields three masks; those with a high
predicted overlap and a stable border are kept, without duplicates.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from toolkit.base.keyframe import Keyframe
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.models.layers import layered
from toolkit.scene.instances.options import InstanceModelOptions
from toolkit.semantics.features.pretrained.loading import device_of, load_model
from toolkit.semantics.features.pretrained.preprocessing import ImagePreprocessing

_MIN_SCORE = 0.8
# Minimum stability: overlap of the masks whose thresholds differ from 0 by this much.
_MIN_STABILITY, _OFFSET = 0.92, 1.0
# Minimum intersection over union of duplicates.
_DUPLICATE = 0.7
# Number of points that are decoded together; limits memory.
_BATCH = 64
# Masks of more than this fraction of the image show the background; those of fewer pixels of the
# model's masks are noise.
_MAX_SHARE, _MIN_PIXELS = 0.95, 12


class Sam2Masks:
    """Masks without classes from a grid of points.

    Args:
        folder: of a SAM 2 model.
        options: number of points, minimum score (0.8 by default) and device.

    Raises:
        DependencyError: transformers cannot be loaded or is too old, or the device is not
            available.
        FormatError: the folder is invalid.
    """

    def __init__(self, folder: Path, options: InstanceModelOptions) -> None:
        self._device = device_of(options.device)
        self._model = load_model("Sam2Model", folder).to(self._device)
        self._images = ImagePreprocessing.load(folder)
        self._side = int(self._model.config.prompt_encoder_config.image_size)
        self._min_score = _MIN_SCORE if options.min_score is None else options.min_score
        centres = (
            (torch.arange(options.points, dtype=torch.float32) + 0.5) / options.points * self._side
        )
        x, y = torch.meshgrid(centres, centres, indexing="xy")
        self._points = torch.stack([x, y], dim=-1).reshape(1, -1, 1, 2).to(self._device)

    @torch.inference_mode()
    def masks(self, keyframe: Keyframe) -> InstanceMasks:
        """Return the masks of a keyframe."""
        side = (self._side, self._side)
        pixels = self._images.prepared(keyframe.rgb.to(self._device), side)
        features = self._model.get_image_embeddings(pixels)
        found = [self._decoded(features, part) for part in self._points.split(_BATCH, dim=1)]
        logits, scores = (torch.cat([one[k] for one in found]) for k in (0, 1))
        kept = _without_duplicates(logits > 0, scores)
        size = (keyframe.camera.height, keyframe.camera.width)
        full = [
            torch.nn.functional.interpolate(
                logits[k][None, None], size, mode="bilinear", align_corners=False
            )[0, 0]
            for k in kept
        ]
        masks: list[np.ndarray] = [(one > 0).cpu().numpy() for one in full]
        return layered(masks, scores[kept].tolist(), [None] * len(kept), size)

    def _decoded(self, features: list[Tensor], points: Tensor) -> tuple[Tensor, Tensor]:
        """Logits [K, h, w] and scores [K] of the good masks at points [1, P, 1, 2]."""
        output = self._model(image_embeddings=list(features), input_points=points)
        logits = output.pred_masks.flatten(0, 2).float()
        scores = output.iou_scores.flatten().float()
        inner = (logits > _OFFSET).sum(dim=(1, 2))
        outer = (logits > -_OFFSET).sum(dim=(1, 2))
        area = (logits > 0).sum(dim=(1, 2))
        good = (scores >= self._min_score) & (inner >= _MIN_STABILITY * outer)
        good &= (area >= _MIN_PIXELS) & (area <= _MAX_SHARE * logits[0].numel())
        return logits[good], scores[good]


def _without_duplicates(masks: Tensor, scores: Tensor) -> list[int]:
    """Indices of masks [K, h, w] in the order of their scores, without those like better ones."""
    order = torch.argsort(scores, descending=True, stable=True).tolist()
    small = masks[:, ::2, ::2].flatten(1).float()
    shared = small @ small.T
    area = shared.diagonal()
    same = shared >= _DUPLICATE * (area[:, None] + area - shared)
    kept: list[int] = []
    for k in order:
        if not bool(same[k, kept].any()):
            kept.append(k)
    return kept
