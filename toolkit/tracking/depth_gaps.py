"""Gaps in depth images: single pixels without depth inside of a surface.

Depth that was registered to colour has curves of missing pixels where its pixels moved apart, a
tenth of the image in recordings of a HoloLens. Windows around them are incomplete, so that planes
are not found, normals are missing and free space is not certain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.native import kernels

# Maximum difference of the inverse depths on both sides of a gap, relative to their mean.
_MAX_DIFFERENCE = 0.05


def without_gaps(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill missing pixels between two neighbours on opposite sides that belong to one surface.

    Args:
        inverse: [H, W] inverse depth in 1 / m, 0 where missing.

    Returns:
        [H, W] with the mean of the pairs of opposite neighbours in the gaps, otherwise unchanged.
    """
    module = kernels()
    if module is None:
        return _without_gaps_numpy(inverse)
    inverse, filled = np.ascontiguousarray(inverse), np.empty(inverse.shape, np.float32)
    size = inverse.shape[::-1]
    module.fill_depth_gaps(size, inverse.ctypes.data, _MAX_DIFFERENCE, filled.ctypes.data)
    return filled


def _without_gaps_numpy(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """As `without_gaps`, in NumPy: reference and fallback of the native kernel."""
    width = inverse.shape[1] + 2
    padded = np.pad(inverse, 1).reshape(-1)
    rows, columns = np.nonzero(inverse == 0)
    places = (rows + 1) * width + columns + 1
    total, count = np.zeros((2, len(places)), np.float32)
    for step in (1, width - 1, width, width + 1):
        one, other = padded[places - step], padded[places + step]
        mean = 0.5 * (one + other)
        closed = (one > 0) & (other > 0) & (np.abs(one - other) < _MAX_DIFFERENCE * mean)
        total += np.where(closed, mean, 0.0)
        count += closed
    gap = count > 0
    filled = inverse.copy()
    filled[rows[gap], columns[gap]] = total[gap] / count[gap]
    return filled
