"""Memory of a map's parameters."""

from __future__ import annotations

_FLOAT_BYTES = 4
# Centre, radius, opacity and colour.
_GEOMETRY_FLOATS = 3 + 1 + 1 + 3


def gaussian_bytes(feature_channels: int) -> int:
    """Return the size of one Gaussian's float32 parameters, in bytes."""
    return _FLOAT_BYTES * (_GEOMETRY_FLOATS + feature_channels)
