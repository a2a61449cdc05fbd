"""Turning and mirroring of images, and of their intrinsics, by EXIF's orientation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera

# Directions of the shown image's x and y in the stored image, by orientation.
_AXES = {
    1: ((1, 0), (0, 1)),
    2: ((-1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    4: ((1, 0), (0, -1)),
    5: ((0, 1), (1, 0)),
    6: ((0, -1), (1, 0)),
    7: ((0, -1), (-1, 0)),
    8: ((0, 1), (-1, 0)),
}


def swaps_sides(orientation: int) -> bool:
    """Whether width and height are exchanged."""
    return orientation >= 5


def oriented(image: NDArray, orientation: int) -> NDArray:
    """Turn stored pixels [H, W, ...] as they are to be shown."""
    axes = np.array(_AXES[orientation])
    if swaps_sides(orientation):
        image = image.swapaxes(0, 1)
    right, down = axes.sum(1)
    return np.ascontiguousarray(image[::down, ::right])


def oriented_camera(camera: Camera, orientation: int) -> Camera:
    """Intrinsics of the shown image from those of the stored one."""
    axes = np.array(_AXES[orientation], float)
    width, height = np.abs(axes) @ camera.size
    # A reversed axis starts at the last pixel of the other end.
    shift = np.array([width - 1, height - 1]) * (axes.sum(1) < 0)
    cx, cy = axes @ [camera.cx, camera.cy] + shift
    fx, fy = np.abs(axes) @ [camera.fx, camera.fy]
    return Camera(float(fx), float(fy), float(cx), float(cy), int(width), int(height))


def oriented_distortion(distortion: tuple[float, ...], orientation: int) -> tuple[float, ...]:
    """OpenCV's coefficients (k1, k2, p1, p2, k3, ...) for the shown image.

    The tangential terms are 2 (a x) x + |x|^2 a with a = (p2, p1), so that a turns with the image.
    """
    k1, k2, p1, p2, *others = distortion
    p2, p1 = np.array(_AXES[orientation], float) @ [p2, p1]
    return (k1, k2, float(p1), float(p2), *others)
