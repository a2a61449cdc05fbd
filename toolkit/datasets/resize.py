"""Resizing of images: uniform scaling, then a centre crop."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DatasetError
from toolkit.geometry.camera import Camera

# Maximum relative difference in inverse depth of source pixels on the surface of the centre.
_EDGE = 0.05


def resize_colour(rgb: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Resize a colour image [H, W, 3] to (width, height) by area averaging or linear upsampling."""
    width, height = size
    smaller = width < rgb.shape[1] or height < rgb.shape[0]
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(rgb, size, interpolation=method), dtype=np.float32)


def enlarge_depth(depth_m: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Enlarge a depth image [H, W] to (width, height) by nearest neighbour."""
    return np.asarray(cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT))


class ImageGrid:
    """Pixel grid to which the images of one camera are resampled.

    All images use one grid, c' = (c + 0.5) s - 0.5. Colour is averaged over the area of each
    pixel. Inverse depth, which is linear on planes, is averaged over the part of the area that
    belongs to the surface at its centre. Labels are those of the source pixel that contains the
    centre; at half resolution this is a shift of a quarter of a pixel in a constant direction.

    Args:
        source: camera of the source images.
        size: target (width, height) in pixels.

    Raises:
        DatasetError: the target size is less than one pixel.
    """

    def __init__(self, source: Camera, size: tuple[int, int]) -> None:
        width, height = size
        if width < 1 or height < 1:
            raise DatasetError(f"image size must be at least 1x1, got {width}x{height}")
        scale = max(width / source.width, height / source.height)
        scaled_width = max(width, round(source.width * scale))
        scaled_height = max(height, round(source.height * scale))
        left, top = (scaled_width - width) // 2, (scaled_height - height) // 2
        # The factors differ slightly because sizes are integers; the camera uses the exact ones.
        scale_x, scale_y = scaled_width / source.width, scaled_height / source.height

        self.camera = source.scaled(scale_x, scale_y, scaled_width, scaled_height).cropped(
            left, top, width, height
        )
        self._scaled_size = (scaled_width, scaled_height)
        self._crop = np.s_[top : top + height, left : left + width]
        columns = ((np.arange(left, left + width) + 0.5) / scale_x).astype(np.int64)
        rows = ((np.arange(top, top + height) + 0.5) / scale_y).astype(np.int64)
        self._source_pixels = np.ix_(rows, columns)
        self._rows = _covered(np.arange(top, top + height), scale_y, source.height)
        self._columns = _covered(np.arange(left, left + width), scale_x, source.width)

    def colour(self, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample a colour image [H, W, 3] to this grid."""
        return np.ascontiguousarray(resize_colour(rgb, self._scaled_size)[self._crop])

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample a depth image [H, W] (m, 0 where missing) without mixing surfaces."""
        inverse = np.where(depth_m > 0, 1.0 / np.where(depth_m > 0, depth_m, 1.0), 0.0)
        middle = inverse[self._source_pixels]
        total, area = np.zeros_like(middle), np.zeros_like(middle)
        for rows, heights in self._rows:
            for columns, widths in self._columns:
                other = inverse[np.ix_(rows, columns)]
                same = np.abs(other - middle) < _EDGE * middle
                coverage = heights[:, None] * widths * same
                total += coverage * other
                area += coverage
        known = total > 0
        return np.where(known, area / np.where(known, total, 1.0), 0.0).astype(np.float32)

    def nearest(self, image: NDArray) -> NDArray:
        """Resample a label image [H, W] to this grid by nearest neighbour."""
        return image[self._source_pixels]


def _covered(
    pixels: NDArray[np.int64], scale: float, count: int
) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return the source pixels that target pixels cover along one axis, with their coverage."""
    first, last = pixels / scale, (pixels + 1) / scale
    parts = []
    for step in range(int(np.ceil(1.0 / scale)) + 1):
        source = np.floor(first).astype(np.int64) + step
        coverage = np.minimum(source + 1, last) - np.maximum(source, first)
        coverage = np.where(source < count, np.maximum(coverage, 0.0), 0.0)
        if coverage.max() > 1e-9:
            parts.append((np.minimum(source, count - 1), coverage))
    return parts
