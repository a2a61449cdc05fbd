"""Shapes and view-dependent colours of anisotropic splats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Factors of the harmonics of the degrees 1 to 3 where the axes y and z are reversed.
_REVERSED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


@dataclass(frozen=True)
class SplatShapes:
    """Shapes of N splats, with the names of `gaussians.ellipsoids.Ellipsoids`.

    Attributes:
        log_scales: [N, 3] float32, natural logarithms of the standard deviations in metres.
        rotations: [N, 4] float32, quaternions wxyz of any length > 0, from axes to map.
        harmonics: [N, K, 3] float32 with K of 0, 3, 8 or 15, added to the colour.
    """

    log_scales: NDArray[np.float32]
    rotations: NDArray[np.float32]
    harmonics: NDArray[np.float32]

    def with_reversed_axes(self) -> SplatShapes:
        """Return the shapes after a half turn about the x axis."""
        turn = np.array([1, 1, -1, -1], np.float32)
        signs = _REVERSED[: self.harmonics.shape[1], None]
        return SplatShapes(self.log_scales, self.rotations * turn, self.harmonics * signs)


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
