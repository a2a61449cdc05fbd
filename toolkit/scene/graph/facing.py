"""The side that objects face: away from the back of a seat, or from the wall behind a panel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A seat: the middle of its front half ends at this height above the floor and at most at this share
# of the height of the object. The back is what is higher than the arms.
_SEAT_M, _SEAT_SHARE, _BACK_SHARE = (0.25, 0.65), 0.7, 0.82
# Limits of the sides of a seat: a bed has a back as well, but is deeper.
_MIN_SIDE_M, _MAX_SIDE_M, _MAX_DEPTH_M = 0.3, 3.0, 1.3
# Minimum distance from the back to the middle of the object, relative to its depth.
_MIN_OFFSET = 0.15
# A panel (screen, picture, board) is upright, thin relative to its width and above the floor. Its
# lowest part can be a foot, which is not thin.
_PANEL_RATIO, _MAX_PANEL_M, _FOOT_SHARE = 0.3, 0.15, 0.4
_MIN_PANEL_M, _MIN_PANEL_HEIGHT_M = 0.2, 0.3
# Minimum number of points of a back, or of the wall behind a panel, and of their distance.
_MIN_POINTS, _MIN_BEHIND_M = 8, 0.005


def front_of(points: Array, cameras: Array, wall: Array) -> Array | None:
    """Return the horizontal direction [2] that an object faces, None if it has no front.

    Args:
        points: [N, 3] points of the object; the third axis is up, and the floor is at z = 0.
        cameras: [P, 3] positions of the camera in the same axes: panels that hang at no wall face
            them.
        wall: [M, 3] points around the object of the wall that it hangs at; M may be 0.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low
    upper = points[points[:, 2] >= low[2] + _FOOT_SHARE * size[2]]
    axes, (thin, wide) = _flat_axes(upper)
    if thin <= min(_MAX_PANEL_M, _PANEL_RATIO * wide) and low[2] >= _MIN_PANEL_HEIGHT_M:
        if min(wide, size[2]) < _MIN_PANEL_M:
            return None
        normal, centre = axes[:, 0], upper[:, :2].mean(axis=0)
        if len(wall) >= _MIN_POINTS:
            # A camera may have seen more of the other side of the wall.
            side = float(np.median((wall[:, :2] - centre) @ normal))
            if abs(side) >= _MIN_BEHIND_M:
                return np.asarray(-np.sign(side) * normal)
        return _seen_side(normal, centre, cameras)
    return _front_of_seat(points, float(high[2]))


def _front_of_seat(points: Array, height_m: float) -> Array | None:
    """Return the direction from the back of a seat to its middle; None if it is no seat."""
    axes, extent = _flat_axes(points)
    above = points[:, 2] > _BACK_SHARE * height_m
    if (
        extent[0] < _MIN_SIDE_M
        or extent[1] > _MAX_SIDE_M
        or min(above.sum(), (~above).sum()) < _MIN_POINTS
    ):
        return None
    along = points[:, :2] @ axes
    # The middle of extents instead of means: density of points varies.
    middle = _middle(along)
    offset = middle - _middle(along[above])
    axis = int((np.abs(offset) / np.maximum(extent, 1e-6)).argmax())
    if abs(offset[axis]) < _MIN_OFFSET * extent[axis] or extent[axis] > _MAX_DEPTH_M:
        return None
    # Between the arms.
    across = np.abs(along[:, 1 - axis] - middle[1 - axis]) <= extent[1 - axis] / 4
    ahead = across & (np.sign(offset[axis]) * (along[:, axis] - middle[axis]) > 0)
    if not ahead.any():
        return None
    seat_m = float(np.percentile(points[ahead, 2], 95))
    is_seat = _SEAT_M[0] <= seat_m <= min(_SEAT_M[1], _SEAT_SHARE * height_m)
    return np.asarray(np.sign(offset[axis]) * axes[:, axis]) if is_seat else None


def _flat_axes(points: Array) -> tuple[Array, Array]:
    """Return the horizontal axes [2, 2] of points as columns, the thin one first, and extents."""
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    _, axes = np.linalg.eigh(flat.T @ flat if len(flat) > 2 else np.eye(2))
    return axes, np.ptp(flat @ axes, axis=0)


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
