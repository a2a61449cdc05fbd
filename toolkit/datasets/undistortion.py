"""Removal of lens distortion from colour, depth and label images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera


class Undistortion:
    """Resamples distorted images to a pinhole camera with the same intrinsics.

    Depth that is registered to a distorted colour image has the same distortion.

    Args:
        camera: intrinsics of the distorted and undistorted images.
        distortion: OpenCV's (k1, k2, p1, p2, k3[, k4, k5, k6]), or with `fisheye` (k1, k2, k3, k4)
            of the model of Kannala and Brandt.
        fisheye: selects the model.
    """

    def __init__(
        self, camera: Camera, distortion: tuple[float, ...], fisheye: bool = False
    ) -> None:
        rectify = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
        self._map_x, self._map_y = rectify(
            camera.matrix,
            np.array(distortion, dtype=np.float64),
            np.eye(3),
            camera.matrix,
            camera.size,
            cv2.CV_32FC1,
        )

    def colour(self, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """Undistort a colour image [H, W, 3] with bilinear interpolation.

        The border is replicated outside the source image, to avoid artificial edges.
        """
        result = cv2.remap(
            rgb, self._map_x, self._map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(result, dtype=np.float32)

    def nearest(self, image: NDArray) -> NDArray:
        """Undistort a depth or label image [H, W] by nearest neighbour, 0 outside the source."""
        result = cv2.remap(
            image.astype(np.float32),
            self._map_x,
            self._map_y,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
        return result.astype(image.dtype)
