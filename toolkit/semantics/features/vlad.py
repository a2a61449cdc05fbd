"""Encoder of aggregated keypoints: VLAD of RootSIFT descriptors.

Each keypoint (Lowe 2004) is described by RootSIFT (Arandjelovic and Zisserman 2012), reduced by
PCA, and assigned to the nearest word of a vocabulary. The differences from each word are summed and
normalised (VLAD, Jegou et al. 2010, with the normalisation of Arandjelovic and Zisserman 2013).
Keypoints do not move with the image borders and do not depend on the exposure, so views with half
of their content in common remain similar. The descriptors of global encoders do not.

The vocabulary was learned from synthetic rooms only (`data_tools/make_vocabulary.py`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib import resources

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.semantics.features.encoder import check_images
from toolkit.semantics.features.keypoints import Keypoints, detect_keypoints

Array = NDArray[np.float32]

_LONGEST_SIDE = 240  # pixels; larger images take more time and are not recognised better
_KEYPOINTS = 300
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_FILE = "vocabulary.npz"


@dataclass(frozen=True, eq=False)
class VisualVocabulary:
    """Visual words.

    Attributes:
        mean: [128] of RootSIFT descriptors.
        basis: [128, D] principal components.
        words: [K, D].
    """

    mean: Array
    basis: Array
    words: Array

    def aggregate(self, descriptors: NDArray[np.uint8]) -> Array:
        """Unit vector [K * D] of an image's SIFT descriptors [N, 128].

        Without descriptors, all entries are equal.
        """
        words = self.words
        if len(descriptors) == 0:
            return np.full(words.size, words.size**-0.5, np.float32)
        values = (root_sift(descriptors) - self.mean) @ self.basis
        nearest = ((words * words).sum(1) - 2.0 * values @ words.T).argmin(1)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, values - words[nearest])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
        return np.asarray(sums.ravel() / max(float(np.linalg.norm(sums)), 1e-9))


def root_sift(descriptors: NDArray[np.uint8]) -> Array:
    """Square roots of descriptors [N, 128] of unit sum."""
    values = descriptors.astype(np.float32)
    return np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-9))


@functools.cache
def vocabulary() -> VisualVocabulary:
    """The vocabulary of the package."""
    with resources.files(__package__).joinpath(_FILE).open("rb") as stream, np.load(stream) as file:
        return VisualVocabulary(
            *(file[name].astype(np.float32) for name in ("mean", "basis", "words"))
        )


def encoder_keypoints(image: Array) -> Keypoints:
    """Keypoints that represent an image [3, H, W] in [0, 1]."""
    grey = np.tensordot(_LUMA, image, 1)
    height, width = grey.shape
    scale = _LONGEST_SIDE / max(height, width)
    if scale < 1.0:
        size = (max(1, round(scale * width)), max(1, round(scale * height)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return detect_keypoints((255.0 * grey.clip(0.0, 1.0)).round().astype(np.uint8), _KEYPOINTS)


class VladEncoder:
    """VLAD of the strongest keypoints; see the module docstring.

    Distances between true loops and between other views overlap more than those of global encoders
    do, while the order of the distances is much better. The threshold excludes only views without
    any resemblance; candidates should be chosen by rank.
    """

    name = "vlad"
    threshold = 1.30
    differentiable = False

    def __init__(self) -> None:
        self._vocabulary = vocabulary()
        self.dimensions = self._vocabulary.words.size

    def describe(self, images: Tensor) -> Tensor:
        """Descriptors [B, 4096] of images [B, 3, H, W]; not differentiable, see `Encoder`."""
        check_images(images)
        pictures = images.detach().to("cpu", torch.float32).numpy()
        rows = [
            self._vocabulary.aggregate(encoder_keypoints(picture).descriptors)
            for picture in pictures
        ]
        return torch.from_numpy(np.array(rows, np.float32)).to(images.device)
