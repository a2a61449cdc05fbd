"""Voxels of a regular grid, each with one number, so that sets of them are arrays of integers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Three coordinates are packed in 64 bits: voxels on each side of the origin.
_BITS = 21
_HALF = 1 << (_BITS - 1)


def voxels_of(points: NDArray, size_m: float) -> NDArray[np.int64]:
    """Coordinates [N, 3] of the voxels that contain finite points [N, 3]."""
    return np.floor(points / size_m).astype(np.int64)


def voxel_keys(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """A number [N] for each voxel [N, 3], ordered by x, y and z.

    It is unique within a million voxels of the origin.
    """
    x, y, z = (voxels + _HALF).T
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)


def voxels_of_keys(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The voxels [N, 3] of their numbers [N]."""
    mask = (1 << _BITS) - 1
    return np.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], axis=1) - _HALF
