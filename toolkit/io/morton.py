"""Morton order (Z-order): a curve through space on which neighbours are mostly close."""

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


def morton_order(positions: NDArray[np.floating]) -> NDArray[np.int64]:
    """The indices [N] that sort positions [N, 3] along the curve.

    A point that is far away from the others does not make the cells coarse: these are a fraction of
    the range after the logarithm of the distance from the median.
    """
    from_median = positions.astype(np.float64) - np.median(positions, axis=0)
    spread = np.maximum(np.abs(from_median).mean(axis=0), 1e-12)
    logarithms = np.arcsinh(from_median / spread)
    side = max(float(np.ptp(logarithms, axis=0).max()), 1e-12)
    codes = morton_codes(logarithms, logarithms.min(axis=0), side, MAX_BITS)
    return np.argsort(codes, kind="stable").astype(np.int64)


def morton_codes(
    points: NDArray[np.floating], low: NDArray[np.floating], side: float, bits: int
) -> NDArray[np.int64]:
    """Return the number [N] of the cell of each point along the curve.

    Args:
        points: [N, 3] points; those outside of the cube count for its nearest cells.
        low: [3] corner of the cube with the lowest coordinates.
        side: side of the cube, > 0.
        bits: the cube is divided into 2^bits cells along each axis, 1 to 21.
    """
    last = (1 << bits) - 1
    codes = np.zeros(len(points), np.int64)
    for axis in range(3):
        cells = (points[:, axis] - low[axis]) / side * last
        codes |= _spread(cells.clip(0, last).astype(np.int64)) << axis
    return codes


def _spread(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Insert two zeros above each bit."""
    for shift, kept in _SPREADING:
        values = (values | (values << shift)) & kept
    return values
