"""How much room a map's Gaussians take."""

from __future__ import annotations

from toolkit.evaluation.metrics import Metrics

_FLOAT_BYTES = 4
# Centre, radius, opacity and colour.
_GEOMETRY_FLOATS = 3 + 1 + 1 + 3


def gaussian_bytes(feature_channels: int) -> int:
    """Bytes of one Gaussian's parameters, float32."""
    return _FLOAT_BYTES * (_GEOMETRY_FLOATS + feature_channels)


def storage_metrics(gaussians: int, feature_channels: int) -> Metrics:
    """Bytes a Gaussian and MB (10^6 bytes) of a map, in all and of its semantic code alone.

    Args:
        gaussians: how many the map has.
        feature_channels: semantic channels of each.
    """
    semantic = _FLOAT_BYTES * feature_channels
    return {
        "feature_channels": feature_channels,
        "gaussian_bytes": gaussian_bytes(feature_channels),
        "gaussian_semantic_bytes": semantic,
        "map_mb": gaussian_bytes(feature_channels) * gaussians / 1e6,
        "map_semantic_mb": semantic * gaussians / 1e6,
    }
