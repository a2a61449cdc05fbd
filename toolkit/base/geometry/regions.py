"""Connected regions of an image of classes."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def connected_regions(
    class_ids: NDArray[np.integer], connectivity: int = 8, min_pixels: int = 1
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the connected regions of pixels of one class.

    Args:
        class_ids: [H, W] class of each pixel; 0 and less belong to no region.
        connectivity: 4 or 8 neighbours.
        min_pixels: smaller regions are left out.

    Returns:
        Region [H, W] of each pixel, from 1 in the order of classes and 0 for none, and the class
        [R] of each region.
    """
    regions = np.zeros(class_ids.shape, np.int32)
    classes: list[int] = []
    for class_id in np.flatnonzero(np.bincount(class_ids[class_ids > 0])).tolist():
        mask = (class_ids == class_id).astype(np.uint8)
        # Most classes fill a small part of an image.
        x, y, width, height = cv2.boundingRect(mask)
        box = np.s_[y : y + height, x : x + width]
        count, pieces, statistics, _ = cv2.connectedComponentsWithStats(
            mask[box], connectivity=connectivity
        )
        large = np.flatnonzero(statistics[1:, cv2.CC_STAT_AREA] >= min_pixels) + 1
        table = np.zeros(count, np.int32)
        table[large] = np.arange(len(classes) + 1, len(classes) + len(large) + 1)
        regions[box] += table[pieces]
        classes += [class_id] * len(large)
    return regions, np.array(classes, np.int32)
