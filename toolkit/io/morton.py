"""Morton order of points: neighbours in space are close to each other in the order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BITS = 21


def morton_order(positions: NDArray[np.floating]) -> NDArray[np.int64]:
    """The indices [N] that sort positions [N, 3] along a Z-order curve.

    A point that is far away from the others does not make the cells coarse: these are a fraction of
    the range after the logarithm of the distance from the median.
    """
    from_median = positions.astype(np.float64) - np.median(positions, axis=0)
    spread = np.maximum(np.abs(from_median).mean(axis=0), 1e-12)
    logarithms = np.arcsinh(from_median / spread)
    low = logarithms.min(axis=0)
    size = np.maximum(np.ptp(logarithms, axis=0).max(), 1e-12)
    cells = ((logarithms - low) / size * (2**_BITS - 1)).astype(np.uint64)
    keys = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        keys |= _spread_bits(cells[:, axis]) << np.uint64(axis)
    return np.argsort(keys, kind="stable").astype(np.int64)


def _spread_bits(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Put two zeros between the bits of integers of 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values
