"""Morton order: a curve through space on which neighbours are mostly close."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Steps of `_spread`: shift and the bits that remain.
_SPREADING = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
MAX_BITS = 21


def morton_codes(
    means_m: NDArray[np.float32], low_m: NDArray[np.floating], side_m: float, bits: int
) -> NDArray[np.int64]:
    """Return the number [N] of the cell of each point along the curve.

    Args:
        means_m: [N, 3] points; those outside of the cube count for its nearest cells.
        low_m: [3] corner of the cube with the lowest coordinates.
        side_m: side of the cube, > 0.
        bits: the cube is divided into 2^bits cells along each axis, 1 to 21.
    """
    last = (1 << bits) - 1
    codes = np.zeros(len(means_m), np.int64)
    for axis in range(3):
        cells = (means_m[:, axis] - low_m[axis]) / side_m * last
        codes |= _spread(cells.clip(0, last).astype(np.int64)) << axis
    return codes


def _spread(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Insert two zeros above each bit."""
    for shift, kept in _SPREADING:
        values = (values | (values << shift)) & kept
    return values
