"""Masks of COCO: run-length encodings, compressed or not, and polygons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

# Compressed counts are numbers of 5 bits per character, from this character, with a flag for more.
_FIRST, _BITS, _MORE = 48, 5, 0x20
# A mask of no pixels has a count, too.
_MAX_LENGTH = 16


def decoded_mask(segmentation: Any, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Decode the `segmentation` of a COCO annotation.

    Args:
        segmentation: polygons, or a mapping with `size` and `counts`.
        size: height and width of the image.

    Returns:
        The mask [H, W].

    Raises:
        ValueError: it is neither, or does not have this size.
    """
    if isinstance(segmentation, dict):
        return _run_lengths(segmentation, size)
    if isinstance(segmentation, list) and all(isinstance(p, list) for p in segmentation):
        return _polygons(segmentation, size)
    raise ValueError("segmentation is neither polygons nor a run-length encoding")


def _run_lengths(encoded: dict[str, Any], size: tuple[int, int]) -> NDArray[np.bool_]:
    given = encoded.get("size")
    if not isinstance(given, list) or tuple(given) != size:
        raise ValueError(f"the mask has size {given}, the image {list(size)}")
    counts = encoded.get("counts")
    # Each run has a pixel, and lengths of up to five characters are rare.
    if isinstance(counts, (str, list)) and len(counts) > _MAX_LENGTH + 5 * size[0] * size[1]:
        raise ValueError(f"{len(counts)} counts are too many for {size[1]}x{size[0]} pixels")
    if isinstance(counts, str):
        counts = compressed_counts(counts)
    if not isinstance(counts, list) or not all(isinstance(c, int) and c >= 0 for c in counts):
        raise ValueError("counts are neither a list of lengths nor compressed")
    height, width = size
    if sum(counts) != height * width:
        raise ValueError(f"counts sum to {sum(counts)} instead of {height * width} pixels")
    # Runs alternate between outside and inside, column by column.
    values = np.arange(len(counts)) % 2 == 1
    return np.repeat(values, counts).reshape(width, height).T


def compressed_counts(text: str) -> list[int]:
    """The run lengths of COCO's compressed text.

    Each number is written in groups of 5 bits, the lowest first, with sign extension. From the
    fourth run, it is the difference to the run before the last.

    Raises:
        ValueError: the text is truncated or has other characters.
    """
    counts: list[int] = []
    value = shift = 0
    for character in text:
        code = ord(character) - _FIRST
        if not 0 <= code < 64:
            raise ValueError(f"compressed counts have the character {character!r}")
        value |= (code & (_MORE - 1)) << shift
        shift += _BITS
        if code & _MORE:
            continue
        if code & 0x10:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("compressed counts are truncated")
    return counts


def _polygons(polygons: Sequence[Sequence[float]], size: tuple[int, int]) -> NDArray[np.bool_]:
    mask = np.zeros(size, np.uint8)
    for polygon in polygons:
        points = np.asarray(polygon, np.float64)
        if points.ndim != 1 or len(points) < 6 or len(points) % 2 or not np.isfinite(points).all():
            raise ValueError("a polygon needs pairs of finite coordinates of three points or more")
        # COCO's coordinates are those of pixel corners; pixels on the border are inside.
        corners = np.floor(points.reshape(-1, 1, 2))
        cv2.fillPoly(mask, [np.clip(corners, -(2**15), 2**15).astype(np.int32)], 1)
    return mask > 0
