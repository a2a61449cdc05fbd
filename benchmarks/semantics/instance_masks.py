"""Masks for the benchmark of instances: true ones with random numbers, degraded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.keyframe import Keyframe
from toolkit.io.images import read_labels
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.semantics.segmenters.image_folder import resized_labels

Ids = NDArray[np.int32]


@dataclass(frozen=True)
class Faults:
    """Faults of masks; fractions are of the masks of a frame.

    Attributes:
        dropped: masks that are missing.
        merged: masks that are one with a neighbour.
        halved: masks of which the left and the right half are two.
        eroded: pixels that are missing at the borders of masks.
        embedded: noise of the embeddings relative to their length; None without embeddings.
    """

    dropped: float = 0.0
    merged: float = 0.0
    halved: float = 0.0
    eroded: int = 0
    embedded: float | None = None


class TrueMasks:
    """The true instances of keyframes, with numbers that restart in every frame, and faults.

    Args:
        folder: of the images `instanceNNNNNN.png`.
        faults: of the masks.
        seed: of all random values.
    """

    def __init__(self, folder: Path, faults: Faults, seed: int = 0) -> None:
        self._folder, self._faults, self._seed = folder, faults, seed

    def truth(self, keyframe: Keyframe) -> Ids:
        """The true instances [H, W] of a keyframe, 0 for none."""
        file = self._folder / f"instance{keyframe.index:06d}.png"
        return resized_labels(read_labels(file), keyframe.camera.size, file)

    def masks(self, keyframe: Keyframe) -> InstanceMasks:
        """The masks of a keyframe."""
        rng = np.random.default_rng([self._seed, keyframe.index])
        ids = _with_faults(self.truth(keyframe), self._faults, rng)
        found = np.unique(ids[ids > 0])
        table = np.zeros(int(ids.max(initial=0)) + 1, np.int32)
        table[rng.permutation(found)] = np.arange(1, len(found) + 1)
        shuffled = table[ids]
        embeddings = np.zeros((len(found), 0), np.float32)
        if self._faults.embedded is not None:
            embeddings = np.zeros((len(found), 16), np.float32)
            for number in found:
                own = np.random.default_rng([7, int(number)]).standard_normal(16)
                noise = self._faults.embedded * rng.standard_normal(16)
                embeddings[table[number] - 1] = own + noise
            embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
        count = len(found)
        return InstanceMasks(shuffled, [None] * count, np.ones(count, np.float32), embeddings)


def _with_faults(ids: Ids, faults: Faults, rng: np.random.Generator) -> Ids:
    original = ids
    if faults.eroded:
        size = 2 * faults.eroded + 1
        kernel = np.ones((size, size), np.uint8)
        high = cv2.dilate(ids.astype(np.float32), kernel)
        low = cv2.erode(ids.astype(np.float32), kernel)
        ids = np.where(high == low, ids, 0).astype(np.int32)
    next_id = int(original.max(initial=0)) + 1
    for number in np.unique(original[original > 0]):
        mask = ids == number
        if rng.random() < faults.dropped:
            ids = np.where(mask, 0, ids)
        elif rng.random() < faults.merged:
            around = cv2.dilate((original == number).astype(np.uint8), np.ones((5, 5))) > 0
            others = np.setdiff1d(original[around], [0, number])
            if len(others):
                ids = np.where(mask, rng.choice(others), ids)
        elif rng.random() < faults.halved and mask.any():
            columns = np.arange(ids.shape[1])[None]
            middle = np.median(np.nonzero(mask)[1])
            ids = np.where(mask & (columns > middle), next_id, ids)
            next_id += 1
    return ids.astype(np.int32)
