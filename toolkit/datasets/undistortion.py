"""Take the lens distortion out of colour, depth and labels alike."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.camera import Camera


class Undistortion:
    """Resampling of images with a distorting lens to a pinhole of the same intrinsics.

    Depth registered to a distorted colour image is distorted with it.

    Args:
        camera: intrinsics of the images, before and after.
        distortion: OpenCV's (k1, k2, p1, p2, k3).
    """

    def __init__(self, camera: Camera, distortion: tuple[float, ...]) -> None:
        self._map_x, self._map_y = cv2.initUndistortRectifyMap(
            camera.matrix,
            np.array(distortion, dtype=np.float64),
            np.eye(3),
            camera.matrix,
            camera.size,
            cv2.CV_32FC1,
        )

    def colour(self, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """A colour image [H, W, 3], bilinear.

        Beyond the source its border is repeated: black would be an edge that is not there.
        """
        result = cv2.remap(
            rgb, self._map_x, self._map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(result, dtype=np.float32)

    def nearest(self, image: NDArray) -> NDArray:
        """A depth or label image [H, W]: nearest value, 0 beyond the source."""
        result = cv2.remap(
            image.astype(np.float32),
            self._map_x,
            self._map_y,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
        return result.astype(image.dtype)
