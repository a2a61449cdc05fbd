"""The side that objects face: away from the back of a seat, or the seen side of a panel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A back: what is above this share of the height. Its centre is at least this share of the depth of
# the object behind the centre of the rest, and its height is that of furniture for sitting.
_BACK_FROM, _MIN_OFFSET = 0.7, 0.2
_MIN_HEIGHT_M, _MAX_HEIGHT_M = 0.5, 1.3
_MAX_SIDE_M = 3.0
# A panel (screen, picture, board) is upright and thin relative to its width.
_PANEL_RATIO, _MAX_PANEL_M = 0.3, 0.15
_MIN_PANEL_M = 0.2
# Minimum number of points of a back.
_MIN_POINTS = 8


def front_of(points: Array, cameras: Array) -> Array | None:
    """Return the horizontal direction [2] that an object faces, None if it has no front.

    Args:
        points: [N, 3] points of the object; the third axis is up, z = 0 is any height.
        cameras: [P, 3] positions of the camera in the same axes: panels face them.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    _, axes = np.linalg.eigh(np.cov(flat.T) if len(flat) > 2 else np.eye(2))
    extent = np.ptp(flat @ axes, axis=0)  # along the thin axis, along the wide axis
    thin, wide = (float(v) for v in extent)
    if thin <= min(_MAX_PANEL_M, _PANEL_RATIO * wide) and min(wide, size[2]) >= _MIN_PANEL_M:
        return _seen_side(axes[:, 0], points[:, :2].mean(axis=0), cameras)
    if not _MIN_HEIGHT_M <= size[2] <= _MAX_HEIGHT_M or wide > _MAX_SIDE_M:
        return None
    above = points[:, 2] >= low[2] + _BACK_FROM * size[2]
    if min(above.sum(), (~above).sum()) < _MIN_POINTS:
        return None
    # The middle of extents instead of means: density of points varies.
    offset = _middle(points[~above, :2] @ axes) - _middle(points[above, :2] @ axes)
    share = np.abs(offset) / np.maximum(extent, 1e-6)
    axis = int(share.argmax())
    if share[axis] < _MIN_OFFSET:
        return None
    return np.asarray(np.sign(offset[axis]) * axes[:, axis])


def _middle(places: Array) -> Array:
    low, high = np.percentile(places, (5, 95), axis=0)
    return np.asarray((low + high) / 2)


def _seen_side(normal: Array, centre: Array, cameras: Array) -> Array | None:
    """Return the sign of a normal that most of the near cameras see; None without cameras."""
    offsets = cameras[:, :2] - centre
    near = np.linalg.norm(offsets, axis=1) < 4.0
    if not near.any():
        return None
    side = float(np.median(offsets[near] @ normal))
    return normal if side > 0 else -normal
