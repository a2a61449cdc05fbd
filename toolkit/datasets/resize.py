"""Bring images to another size: one uniform scale, then the centre."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DatasetError
from toolkit.geometry.camera import Camera


def resize_colour(rgb: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """A colour image [H, W, 3] averaged over areas to (width, height), or enlarged linearly."""
    width, height = size
    smaller = width < rgb.shape[1] or height < rgb.shape[0]
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(rgb, size, interpolation=method), dtype=np.float32)


class ImageGrid:
    """The pixels that images of one camera are resampled to.

    Colour is averaged over each pixel's area; depth and labels take the source pixel that
    holds the new pixel's centre, so that all three share one grid, c' = (c + 0.5) s - 0.5.

    Args:
        source: the camera of the images as they are.
        size: (width, height) wanted, in pixels.

    Raises:
        DatasetError: a size below one pixel.
    """

    def __init__(self, source: Camera, size: tuple[int, int]) -> None:
        width, height = size
        if width < 1 or height < 1:
            raise DatasetError(f"image size must be at least 1x1, got {width}x{height}")
        scale = max(width / source.width, height / source.height)
        scaled_width = max(width, round(source.width * scale))
        scaled_height = max(height, round(source.height * scale))
        left, top = (scaled_width - width) // 2, (scaled_height - height) // 2
        # Whole pixels make the two factors differ a little; the camera is told the truth.
        scale_x, scale_y = scaled_width / source.width, scaled_height / source.height

        self.camera = source.scaled(scale_x, scale_y, scaled_width, scaled_height).cropped(
            left, top, width, height
        )
        self._scaled_size = (scaled_width, scaled_height)
        self._crop = np.s_[top : top + height, left : left + width]
        columns = ((np.arange(left, left + width) + 0.5) / scale_x).astype(np.int64)
        rows = ((np.arange(top, top + height) + 0.5) / scale_y).astype(np.int64)
        self._source_pixels = np.ix_(rows, columns)

    def colour(self, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """A colour image [H, W, 3] on this grid."""
        return np.ascontiguousarray(resize_colour(rgb, self._scaled_size)[self._crop])

    def nearest(self, image: NDArray) -> NDArray:
        """A depth or label image [H, W] on this grid, values unmixed."""
        return image[self._source_pixels]
