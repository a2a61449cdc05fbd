"""Keypoints: points that can be found again in images from elsewhere (SIFT, Lowe 2004)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_SIZE = 128
# Keypoints of an image that vote for similar images.
_VOTING = 150
# Minimum cosine of two descriptors that count as a vote.
_MIN_COSINE = 0.85


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of an image.

    Attributes:
        px: [N, 2] float64 pixels.
        descriptors: [N, 128] uint8.
        contrast: [N] float32, larger for keypoints that are easier to find again.
    """

    px: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    contrast: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.px)


def detect_keypoints(image: NDArray[np.uint8], count: int) -> Keypoints:
    """Find the strongest keypoints of a grey image [H, W].

    Args:
        count: maximum number of places; a place with two orientations gives two keypoints.
    """
    points, descriptors = cv2.SIFT_create(nfeatures=count).detectAndCompute(image, None)
    if descriptors is None:
        descriptors = np.zeros((0, _SIZE))
    return Keypoints(
        np.array([point.pt for point in points], np.float64).reshape(-1, 2),
        descriptors.astype(np.uint8),
        np.array([point.response for point in points], np.float32),
    )


def match_keypoints(first: Keypoints, second: Keypoints, ratio: float) -> NDArray[np.int64]:
    """Index pairs [M, 2] of mutual nearest neighbours that are distinct in both images.

    Args:
        ratio: maximum ratio of the distances of the nearest and the second nearest descriptor.
    """
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.int64)
    a, b = (keypoints.descriptors.astype(np.float32) for keypoints in (first, second))
    # Sums of products of bytes are exact in float32.
    squared = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * (a @ b.T)
    forward, backward = squared.argmin(1), squared.argmin(0)
    rows = np.arange(len(a))
    good = (backward[forward] == rows) & _distinct(squared, ratio)
    good &= _distinct(squared.T, ratio)[forward]
    return np.stack([rows[good], forward[good]], 1)


def _distinct(squared: NDArray[np.float32], ratio: float) -> NDArray[np.bool_]:
    """Rows whose least distance is much smaller than the second least one."""
    nearest = np.partition(squared, 1, axis=1)[:, :2]
    return np.sqrt(nearest[:, 0]) < ratio * np.sqrt(nearest[:, 1])


def similarity_votes(images: Sequence[Keypoints]) -> NDArray[np.int64]:
    """Numbers [N, N] of similar keypoints between each image (row) and those before it (column).

    The time is quadratic in the number of images: 0.1 ms for each pair.
    """
    votes = np.zeros((len(images), len(images)), np.int64)
    strongest = [_strongest(image) for image in images]
    stacked, ends = _stacked(strongest)
    for row, own in enumerate(strongest):
        votes[row, :row] = _votes(own, stacked, ends[:row])
    return votes


def votes_for(images: Sequence[Keypoints], image: Keypoints) -> NDArray[np.int64]:
    """Numbers [N] of keypoints of each image that are similar to one of another image."""
    return _votes(_strongest(image), *_stacked([_strongest(other) for other in images]))


def _stacked(images: list[NDArray[np.float32]]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The descriptors of all images, and the end of each image's [N]."""
    ends = np.cumsum([len(descriptors) for descriptors in images], dtype=np.int64)
    return np.concatenate([*images, np.zeros((0, _SIZE), np.float32)]), ends


def _votes(
    own: NDArray[np.float32], stacked: NDArray[np.float32], ends: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Numbers [N] of the mutually most similar descriptors of an image and of N others."""
    votes = np.zeros(len(ends), np.int64)
    if not len(own) or not len(ends):
        return votes
    cosines = own @ stacked[: ends[-1]].T
    for column, cosine in enumerate(np.split(cosines, ends[:-1], axis=1)):
        if cosine.size:
            forward, backward = cosine.argmax(1), cosine.argmax(0)
            mutual = backward[forward] == np.arange(len(own))
            votes[column] = (mutual & (cosine.max(1) > _MIN_COSINE)).sum()
    return votes


def _strongest(image: Keypoints) -> NDArray[np.float32]:
    """Descriptors of unit length."""
    order = np.argsort(-image.contrast, kind="stable")[:_VOTING]
    values = image.descriptors[order].astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1.0)
