"""Quaternions without their largest entry, which follows from the length of 1."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def split_largest(
    quaternions: NDArray[np.floating],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The index [N] of the largest entry, and the others [N, 3] in order.

    Args:
        quaternions: [N, 4] of length 1. The sign is chosen such that the largest entry is positive,
            so that the others are within +-1 / sqrt(2).
    """
    q = quaternions.astype(np.float64)
    largest = np.abs(q).argmax(axis=1)
    signs = np.where(np.take_along_axis(q, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.arange(3) + (np.arange(3) >= largest[:, None])
    return largest, signs * np.take_along_axis(q, others, axis=1)


def join_largest(largest: NDArray[np.integer], others: NDArray[np.floating]) -> NDArray[np.float64]:
    """Quaternions [N, 4] from the index [N] of the largest entry and the others [N, 3]."""
    last = np.sqrt(np.maximum(1.0 - (others.astype(np.float64) ** 2).sum(axis=1), 0.0))
    place = np.arange(4) - (np.arange(4) > largest[:, None])
    joined = np.take_along_axis(others.astype(np.float64), np.minimum(place, 2), axis=1)
    joined[np.arange(len(largest)), largest] = last
    return np.asarray(joined)
