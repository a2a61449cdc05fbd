"""How much room a map's Gaussians take."""

from __future__ import annotations

_FLOAT_BYTES = 4
# Centre, radius, opacity and colour.
_GEOMETRY_FLOATS = 3 + 1 + 1 + 3


def gaussian_bytes(feature_channels: int) -> int:
    """Bytes of one Gaussian's parameters, float32."""
    return _FLOAT_BYTES * (_GEOMETRY_FLOATS + feature_channels)
