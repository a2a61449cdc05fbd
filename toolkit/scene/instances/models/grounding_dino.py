"""Grounding DINO: boxes of the objects that words name (Liu et al., 2023), as masks by depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.scene.instances.geometric import depth_steps
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.models.layers import layered
from toolkit.scene.instances.options import InstanceModelOptions
from toolkit.semantics.features.pretrained.loading import device_of, load_model, load_tokenizer
from toolkit.semantics.features.pretrained.preprocessing import ImagePreprocessing

Mask = NDArray[np.bool_]

_MIN_SCORE = 0.3
# Minimum intersection over union of two boxes of one object.
_DUPLICATE = 0.7
# Pixels around the median depth of a box: this fraction of the depth.
_AROUND = 0.05


class GroundingDinoMasks:
    """Masks of the objects that words name; their class is the word.

    Args:
        folder: of a Grounding DINO model.
        options: words, minimum score (0.3 by default) and device.

    Raises:
        DependencyError: transformers cannot be loaded, or the device is not available.
        FormatError: the folder is invalid.
        SettingsError: there are more words than the model reads.
    """

    def __init__(self, folder: Path, options: InstanceModelOptions) -> None:
        self._device = device_of(options.device)
        self._model = load_model("AutoModelForZeroShotObjectDetection", folder).to(self._device)
        self._images = ImagePreprocessing.load(folder)
        self._min_score = _MIN_SCORE if options.min_score is None else options.min_score
        self._words = [" ".join(word.split()) for word in options.text if word.strip()]
        tokenizer, longest = load_tokenizer(folder), int(self._model.config.max_text_len)
        text = " ".join(f"{word.lower().replace('.', ' ')}." for word in self._words)
        self._inputs = tokenizer(text, return_tensors="pt", return_token_type_ids=True)
        ids = self._inputs["input_ids"][0].tolist()
        self._spans = _spans(ids, tokenizer)
        if len(ids) > longest or len(self._spans) != len(self._words):
            raise SettingsError(
                f"--instances.model.text: the model reads {longest} tokens, these words have "
                f"{len(ids)}; give fewer words, and none that consist of signs only"
            )
        self._inputs = self._inputs.to(self._device)

    def class_names(self) -> set[str]:
        """Return the words that are searched."""
        return set(self._words)

    @torch.inference_mode()
    def masks(self, keyframe: Keyframe) -> InstanceMasks:
        """Return the masks of a keyframe."""
        pixels = self._images.prepared(keyframe.rgb.to(self._device))
        output = self._model(pixel_values=pixels, **self._inputs)
        probabilities = output.logits[0].float().sigmoid()
        of_words = torch.stack([probabilities[:, span].amax(dim=1) for span in self._spans], dim=1)
        scores, words = of_words.max(dim=1)
        camera = keyframe.camera
        size = scores.new_tensor([camera.width, camera.height])
        centre, extent = output.pred_boxes[0].float().split(2, dim=1)
        corners = torch.cat([centre - extent / 2, centre + extent / 2], dim=1) * size.repeat(2)
        found = torch.nonzero(scores >= self._min_score)[:, 0]
        found = found[torch.argsort(scores[found], descending=True, stable=True)]
        boxes = corners[found].cpu().numpy()
        kept = _without_duplicates(boxes)
        depth_m = keyframe.depth_m.numpy()
        masks = [box_mask(depth_m, boxes[k], camera) for k in kept]
        chosen = found[kept]
        classes = [self._words[int(word)] for word in words[chosen]]
        return layered(masks, scores[chosen].tolist(), classes, depth_m.shape)


def box_mask(depth_m: NDArray[np.float32], box: NDArray[np.floating], camera: Camera) -> Mask:
    """Return the pixels [H, W] of the surface that a box frames.

    It is the connected region without steps in depth with most pixels around the median depth of
    the box, as far as its depth differs from the median by at most the longer side of the box.

    Args:
        depth_m: [H, W], 0 where missing.
        box: x and y of two corners, in pixels.
        camera: of the image.
    """
    height, width = depth_m.shape
    left, top = np.clip(np.floor(box[:2]), 0, (width, height)).astype(int)
    right, bottom = np.clip(np.ceil(box[2:]), 0, (width, height)).astype(int)
    mask = np.zeros(depth_m.shape, bool)
    inside = depth_m[top:bottom, left:right]
    valid = inside > 0
    if min(inside.shape) < 3 or not valid.any():
        return mask
    median_m = float(np.median(inside[valid]))
    reach_m = median_m * max((right - left) / camera.fx, (bottom - top) / camera.fy)
    smooth = valid & (np.abs(inside - median_m) <= reach_m) & ~depth_steps(inside)
    _, regions = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    near = smooth & (np.abs(inside - median_m) <= _AROUND * median_m)
    if near.any():
        mask[top:bottom, left:right] = regions == np.bincount(regions[near]).argmax()
    return mask


def _without_duplicates(boxes: NDArray[np.floating]) -> list[int]:
    """Indices of boxes [K, 4] without those that nearly equal an earlier one."""
    kept: list[int] = []
    areas = (boxes[:, 2:] - boxes[:, :2]).clip(0).prod(axis=1)
    for k, box in enumerate(boxes):
        low = np.maximum(boxes[kept, :2], box[:2])
        shared = (np.minimum(boxes[kept, 2:], box[2:]) - low).clip(0).prod(axis=1)
        if not (shared >= _DUPLICATE * (areas[kept] + areas[k] - shared)).any():
            kept.append(k)
    return kept


def _spans(ids: Sequence[int], tokenizer: Any) -> list[list[int]]:
    """Places of the tokens of each word; words end with a full stop."""
    stop = tokenizer.convert_tokens_to_ids(".")
    special = set(tokenizer.all_special_ids) - {tokenizer.unk_token_id}
    spans: list[list[int]] = [[]]
    for place, token in enumerate(ids):
        if token == stop:
            spans.append([])
        elif token not in special:
            spans[-1].append(place)
    return [span for span in spans if span]
