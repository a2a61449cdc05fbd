"""Shapes of anisotropic splats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def relative_covariances(
    scales_m: NDArray[np.floating], quaternions: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return covariances [N, 6] in units of the squared geometric mean of the axes.

    Args:
        scales_m: [N, 3] standard deviations along the axes, in metres, > 0.
        quaternions: [N, 4] rotations of the axes, wxyz, of any length > 0.

    Returns:
        The upper triangle xx, xy, xz, yy, yz, zz of each covariance.
    """
    scales_m = scales_m.astype(np.float64)
    axes = scales_m / np.exp(np.log(scales_m).mean(axis=1, keepdims=True))
    stretched = _rotations(quaternions.astype(np.float64)) * axes[:, None, :]
    covariances = stretched @ stretched.transpose(0, 2, 1)
    rows, columns = np.triu_indices(3)
    return covariances[:, rows, columns].astype(np.float32)


def _rotations(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    w, x, y, z = (quaternions / np.maximum(lengths, 1e-12)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
