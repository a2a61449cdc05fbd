"""Write splats as .spz of version 2, which most viewers read; Open3D writes version 4.

Source: the description of the format in github.com/nianticlabs/spz. Axes are x right, y up, z
backward; positions have 24 bits, everything else a byte.
"""

from __future__ import annotations

import gzip
import struct

import numpy as np
from numpy.typing import NDArray

_MAGIC, _VERSION = 0x5053474E, 2
# Bits behind the point of a position: 1/4096 m, and up to 2 km.
_FRACTION_BITS = 12
_COLOUR_SCALE = 0.15
_AXES = np.array([1.0, -1.0, -1.0])


def spz_version_2(
    means: NDArray[np.floating],
    log_radii: NDArray[np.floating],
    opacities: NDArray[np.floating],
    harmonics: NDArray[np.floating],
) -> bytes:
    """The content of a .spz file of version 2, of isotropic splats.

    Args:
        means: [N, 3] in metres, x right, y down, z forward.
        log_radii: [N]. opacities: [N] in [0, 1].
        harmonics: [N, 3] constant spherical harmonic of the colours.

    Raises:
        ValueError: a position is more than 2 km from the origin.
    """
    fixed = np.rint(means.astype(np.float64) * _AXES * 2.0**_FRACTION_BITS)
    if fixed.size and np.abs(fixed).max() >= 2**23:
        raise ValueError("positions of a .spz file must be within 2 km of the origin")
    positions = fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    upright = np.full((len(means), 3), 128, np.uint8)  # x, y, z of the identity rotation
    parts = (
        positions,
        _byte(255.0 * opacities),
        _byte(255.0 * (_COLOUR_SCALE * harmonics + 0.5)),
        np.repeat(_byte(16.0 * (log_radii + 10.0))[:, None], 3, axis=1),
        upright,
    )
    head = struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(means), 0, _FRACTION_BITS, 0, 0)
    # No time in the header, so that the same map gives the same file.
    return gzip.compress(head + b"".join(part.tobytes() for part in parts), mtime=0)


def _byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(np.clip(values, 0.0, 255.0)).astype(np.uint8)
