"""Real spherical harmonics of the degrees 1 to 3, with the signs of 3DGS, glTF and USD.

Source: Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023; appendix
A of the glTF extension KHR_gaussian_splatting.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Numbers of harmonics of the degrees 0 to 3, without the constant.
HARMONIC_COUNTS = (0, 3, 8, 15)


def harmonics(x: Any, y: Any, z: Any) -> list[Any]:
    """Return the values of the 15 harmonics after the constant.

    Args:
        x, y, z: coordinates of directions of length 1, as arrays or tensors of one shape.
    """
    xx, yy, zz = x * x, y * y, z * z
    return [
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.4570457994644658 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    ]


def harmonic_rotation(R: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return the matrix [K, K] that rotates the first K = `count` coefficients by R [3, 3].

    The rotated function at R d is the original one at d.
    """
    directions = _directions()
    turned = np.array(harmonics(*(R @ directions.T)))[:count]
    original = np.array(harmonics(*directions.T))[:count]
    return np.asarray(np.linalg.lstsq(turned.T, original.T, rcond=None)[0])


@functools.cache
def _directions() -> NDArray[np.float64]:
    """Directions [64, 3] spread over the sphere, which determine all coefficients."""
    k = np.arange(64) + 0.5
    angle, z = np.pi * (1.0 + 5.0**0.5) * k, 1.0 - k / 32.0
    around = np.sqrt(1.0 - z * z)
    return np.stack([around * np.cos(angle), around * np.sin(angle), z], axis=1)
