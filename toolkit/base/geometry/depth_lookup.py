"""The pixels of a depth image that points project to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class PointDepths:
    """Points in front of a camera whose pixels lie in its image.

    Attributes:
        index: [M] their indices, ascending.
        row, column: [M] their pixels.
        z_m: [M] their depth.
        depth_m: [M] that of the image there.
    """

    index: NDArray[np.intp]
    row: NDArray[np.intp]
    column: NDArray[np.intp]
    z_m: NDArray[np.float64]
    depth_m: NDArray[np.floating]


def depths_at(
    points: NDArray[np.float64], depth_m: NDArray[np.floating], camera: Camera, near_m: float = 0.0
) -> PointDepths:
    """Look up the depth at the pixel nearest to each point; callers decide what is visible.

    Args:
        points: [N, 3] in the frame of the camera.
        depth_m: [H, W] of the camera's image.
        camera: of the image.
        near_m: points up to this depth are not in front of the camera.
    """
    index = np.flatnonzero(points[:, 2] > near_m)
    height, width = depth_m.shape
    pixels = np.rint(camera.project(points[index]))
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    index, (column, row) = index[inside], pixels[inside].astype(np.intp).T
    return PointDepths(index, row, column, points[index, 2], depth_m[row, column])
