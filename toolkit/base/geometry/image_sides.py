"""The direction of up in images, by the side that shows it.

Cameras are usually held so that the top of their images is up. Images of a phone in portrait are
often stored as the sensor sees them, with another side up, and some cameras are mounted upside
down or look straight down.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# The side of the images that is up; backward for a camera that looks down, forward for up.
ImageSide = Literal["top", "right", "bottom", "left", "backward", "forward"]
SIDES: tuple[ImageSide, ...] = get_args(ImageSide)
# The sides of the image, without the directions along the optical axis.
BORDERS: tuple[ImageSide, ...] = SIDES[:4]

# Axes x, y, z of the camera that is turned so that the top of its images is up, in columns.
_R_CAMERA_TURNED = {
    "top": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "bottom": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "left": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "backward": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "forward": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
# A mean direction of up of which less than this part is in the image plane is along the axis.
_MIN_IN_IMAGE = 0.3


def turned_upright(side: ImageSide) -> Array:
    """Return R_camera_turned [3, 3] of the camera turned so that the top of its images is up."""
    return np.array(_R_CAMERA_TURNED[side], np.float64)


def up_in_camera(side: ImageSide) -> Array:
    """Return the unit vector [3] towards a side in camera coordinates."""
    return -turned_upright(side)[:, 1]


def nearest_side(up_camera: Array) -> ImageSide:
    """Return the side that the mean of unit vectors up [N, 3] in camera coordinates points to."""
    mean = np.mean(up_camera, axis=0)
    in_image = float(np.hypot(mean[0], mean[1])) >= _MIN_IN_IMAGE * float(np.linalg.norm(mean))
    sides = BORDERS if in_image else SIDES[4:]
    return max(sides, key=lambda side: float(up_in_camera(side) @ mean))


def mean_up(T_map_cameras: Array, side: ImageSide) -> Array:
    """Return the mean direction up [3] of cameras; shorter than 1 if they differ.

    Args:
        T_map_cameras: poses [M, 4, 4], M >= 1.
        side: the side of their images that is up.
    """
    return np.asarray((T_map_cameras[:, :3, :3] @ up_in_camera(side)).mean(axis=0))
