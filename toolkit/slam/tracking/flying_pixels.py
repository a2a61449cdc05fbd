"""Flying pixels: depth between the two surfaces at a depth edge that belongs to neither.

Sensors and resampling average over a pixel or two at edges. Such a pixel has nearer and farther
neighbours, and few neighbours at its own depth. Those on steep surfaces do as well, so depth may
change as much as on a surface at the steepest angle that is measured reliably; and a pixel stays
where its neighbours continue it in a straight line, as on a plane, in more directions than along an
edge.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.native import kernels

# Half-size of the window around a pixel.
_RADIUS = 2
# Maximum change of depth between neighbouring pixels of one surface: in standard deviations of the
# noise, and as the tangent of the angle of incidence (79 degrees).
_NOISE_SIGMAS, _MAX_TANGENT = 6.0, 5.0
# Minimum fraction of the neighbours at the depth of a pixel.
_MIN_SUPPORT = 0.25
# On a line, inverse depth is linear up to this fraction of it or the noise, and the tangent is at
# most this (85 degrees). Both directions along an edge do not make a surface.
_LINEAR, _MAX_LINE_TANGENT, _MIN_DIRECTIONS = 0.002, 11.0, 3

_Image = NDArray[np.float32]
_Mask = NDArray[np.bool_]


def without_flying_pixels(inverse: _Image, focal: float, noise: float) -> _Image:
    """Remove pixels between the surfaces at a depth edge.

    Args:
        inverse: [H, W] inverse depth in 1 / m, 0 where missing.
        focal: focal length in pixels.
        noise: standard deviation of the noise in inverse depth, 1 / m.

    Returns:
        [H, W], 0 at flying pixels, otherwise unchanged.
    """
    size = 2 * _RADIUS + 1
    window = np.ones((size, size), np.uint8)
    least = np.float32(_NOISE_SIGMAS * noise)
    nearest = cv2.dilate(inverse, window)
    farthest = cv2.erode(np.where(inverse > 0, inverse, np.float32(np.inf)), window)
    module = kernels()
    if module is None:
        step = np.maximum(least, np.float32(_MAX_TANGENT / focal) * inverse)
        between = (inverse > 0) & (nearest - inverse > step) & (inverse - farthest > step)
        return _without_numpy(inverse, between, focal, least, step) if between.any() else inverse
    inverse = np.ascontiguousarray(inverse)
    out = np.empty_like(inverse)
    removed = module.remove_flying_pixels(
        inverse.shape[::-1],
        [image.ctypes.data for image in (inverse, nearest, farthest)],
        (_RADIUS, _MIN_DIRECTIONS),
        (least, _MAX_TANGENT / focal, _MIN_SUPPORT, _LINEAR, _MAX_LINE_TANGENT / focal),
        out.ctypes.data,
    )
    return out if removed else inverse


def _without_numpy(
    inverse: _Image, between: _Mask, focal: float, least: np.float32, step: _Image
) -> _Image:
    """The pixels that neither neighbours nor lines support are set to 0: NumPy reference.

    Args:
        inverse, focal: as in `without_flying_pixels`.
        between: [H, W] mask of the pixels with nearer and farther neighbours.
        least: smallest change of inverse depth that counts.
        step: [H, W] maximum change of inverse depth between neighbours of one surface.
    """
    rows, columns = np.nonzero(between)
    width = inverse.shape[1] + 2 * _RADIUS
    padded = np.pad(inverse, _RADIUS).reshape(-1)
    places = (rows + _RADIUS) * width + columns + _RADIUS
    supported = _has_neighbours(padded, places, width, step[rows, columns])
    tolerance = np.maximum(least, np.float32(_LINEAR) * padded[places])
    steepest = np.float32(_MAX_LINE_TANGENT / focal) * padded[places]
    supported |= _continues(padded, places, width, tolerance, steepest)
    out = inverse.copy()
    out[rows[~supported], columns[~supported]] = 0.0
    return out


def _has_neighbours(
    padded: _Image, places: NDArray[np.int64], width: int, step: NDArray[np.float32]
) -> _Mask:
    """Mask [n] of the pixels that have enough neighbours at their depth.

    Args:
        padded: inverse depth by row. places, width: indices [n] in it, and the length of its rows.
        step: [n] maximum change of inverse depth per pixel.
    """
    own = padded[places]
    alike, measured = np.zeros((2, len(places)), np.int64)
    offsets = range(-_RADIUS, _RADIUS + 1)
    for down, right in ((j, i) for j in offsets for i in offsets if i or j):
        other = padded[places + down * width + right]
        measured += other > 0
        alike += (other > 0) & (np.abs(other - own) <= max(abs(down), abs(right)) * step)
    return np.asarray(alike >= _MIN_SUPPORT * measured)


def _continues(
    padded: _Image,
    places: NDArray[np.int64],
    width: int,
    tolerance: NDArray[np.float32],
    steepest: NDArray[np.float32],
) -> _Mask:
    """Mask [n] of the pixels that continue lines of their neighbours in enough directions.

    Args:
        padded, places, width: as in `_has_neighbours`.
        tolerance: [n] of inverse depth. steepest: [n] maximum change of it per pixel.
    """
    own, directions = padded[places], np.zeros(len(places), np.int64)
    for down, right in ((j, i) for j in (-1, 0, 1) for i in (-1, 0, 1) if i or j):
        shift = down * width + right
        near, far = padded[places + shift], padded[places + 2 * shift]
        line = (near > 0) & (far > 0) & (np.abs(2 * near - far - own) <= tolerance)
        directions += line & (np.abs(near - own) <= steepest)
    return np.asarray(directions >= _MIN_DIRECTIONS)
