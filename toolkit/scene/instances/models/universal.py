"""Mask2Former and OneFormer: a mask, a class and a score for each of some queries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from toolkit.base.errors import FormatError
from toolkit.base.keyframe import Keyframe
from toolkit.io.class_names import VOID_NAMES
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.options import InstanceModelOptions
from toolkit.semantics.features.pretrained.loading import device_of, load_model, load_tokenizer
from toolkit.semantics.features.pretrained.preprocessing import ImagePreprocessing

# A query is hidden if it wins less than this fraction of the pixels of its own mask.
_MIN_VISIBLE = 0.8
_MIN_SCORE = 0.5
# OneFormer was trained with this sentence and task.
_TASK = "the task is panoptic"


class UniversalMasks:
    """Masks of a model for universal segmentation; every pixel goes to one query, as in panoptic
    segmentation.

    Args:
        folder: of a Mask2Former or OneFormer model.
        options: minimum score (0.5 by default) and device.

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not available.
        FormatError: the folder is invalid.
    """

    def __init__(self, folder: Path, options: InstanceModelOptions) -> None:
        self._folder, self._device = folder, device_of(options.device)
        # OneFormer needs its encoder of texts for training only.
        new = ("model.text_mapper.",)
        self._model = load_model("AutoModelForUniversalSegmentation", folder, new)
        self._model.to(self._device)
        self._images = ImagePreprocessing.load(folder)
        self._min_score = _MIN_SCORE if options.min_score is None else options.min_score
        self._task: dict[str, Tensor] = {}
        config = self._model.config
        if config.model_type == "oneformer":
            tokenizer, length = load_tokenizer(folder), int(config.task_seq_len)
            ids = tokenizer(_TASK, padding="max_length", max_length=length, truncation=True)
            task = torch.tensor([ids["input_ids"]], dtype=torch.int64, device=self._device)
            self._task = {"task_inputs": task}
        self._names = {
            int(i): None if str(name).casefold() in VOID_NAMES else str(name)
            for i, name in config.id2label.items()
        }

    def class_names(self) -> set[str]:
        """Return the names of the model's classes."""
        return {name for name in self._names.values() if name is not None}

    @torch.inference_mode()
    def masks(self, keyframe: Keyframe) -> InstanceMasks:
        """Return the visible masks of a keyframe.

        Raises:
            FormatError: the model has other classes than its settings name.
        """
        pixels = self._images.prepared(keyframe.rgb.to(self._device))
        output = self._model(pixel_values=pixels, **self._task)
        probabilities = output.class_queries_logits[0].float().softmax(dim=-1)
        if probabilities.shape[-1] != len(self._names) + 1:
            raise FormatError(
                f"{self._folder}: the model predicts {probabilities.shape[-1] - 1} classes, but "
                f"config.json names {len(self._names)}; correct its id2label"
            )
        scores, classes = probabilities.max(dim=-1)
        wanted = (classes < len(self._names)) & (scores >= self._min_score)
        scores, classes = scores[wanted], classes[wanted]
        # Only for the queries that count: all of them at full size need gigabytes.
        size = (keyframe.camera.height, keyframe.camera.width)
        inside = output.masks_queries_logits[0][wanted].float()[None]
        if not len(scores):
            return InstanceMasks.of_ids(np.zeros(size, np.int32))
        inside = torch.nn.functional.interpolate(
            inside, size, mode="bilinear", align_corners=False
        )[0].sigmoid()
        won = (scores[:, None, None] * inside).argmax(dim=0)
        own = inside >= 0.5
        visible = own & (won[None] == torch.arange(len(scores), device=won.device)[:, None, None])
        areas, shown = own.sum(dim=(1, 2)), visible.sum(dim=(1, 2))
        kept = torch.nonzero((shown > 0) & (shown >= _MIN_VISIBLE * areas))[:, 0]
        ids = torch.zeros(size, dtype=torch.int32, device=won.device)
        for row, query in enumerate(kept, start=1):
            ids[visible[query]] = row
        return InstanceMasks(
            ids.cpu().numpy(),
            [self._names[int(c)] for c in classes[kept]],
            scores[kept].clamp(0.0, 1.0).cpu().numpy(),
            np.zeros((len(kept), 0), np.float32),
        )
