"""Bring images to another size: one uniform scale, then the centre."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DatasetError
from toolkit.geometry.camera import Camera

# Source pixels that differ by less (share of inverse depth) from the one in the middle show its
# surface.
_EDGE = 0.05


def resize_colour(rgb: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """A colour image [H, W, 3] averaged over areas to (width, height), or enlarged linearly."""
    width, height = size
    smaller = width < rgb.shape[1] or height < rgb.shape[0]
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(rgb, size, interpolation=method), dtype=np.float32)


class ImageGrid:
    """The pixels that images of one camera are resampled to.

    All images share one grid, c' = (c + 0.5) s - 0.5. Colour is averaged over each pixel's
    area; so is inverse depth, which is linear on a plane, over the surface in the middle of it
    alone. Labels take the source pixel that holds the new pixel's centre: where images are made
    half as large that is off by a quarter of a new pixel, always to one side.

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
        self._rows = _covered(np.arange(top, top + height), scale_y, source.height)
        self._columns = _covered(np.arange(left, left + width), scale_x, source.width)

    def colour(self, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """A colour image [H, W, 3] on this grid."""
        return np.ascontiguousarray(resize_colour(rgb, self._scaled_size)[self._crop])

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """A depth image [H, W] (m, 0 missing) on this grid; surfaces are not mixed."""
        inverse = np.where(depth_m > 0, 1.0 / np.where(depth_m > 0, depth_m, 1.0), 0.0)
        middle = inverse[self._source_pixels]
        total, area = np.zeros_like(middle), np.zeros_like(middle)
        for rows, heights in self._rows:
            for columns, widths in self._columns:
                other = inverse[np.ix_(rows, columns)]
                same = np.abs(other - middle) < _EDGE * middle
                share = heights[:, None] * widths * same
                total += share * other
                area += share
        known = total > 0
        return np.where(known, area / np.where(known, total, 1.0), 0.0).astype(np.float32)

    def nearest(self, image: NDArray) -> NDArray:
        """A label image [H, W] on this grid, values unmixed."""
        return image[self._source_pixels]


def _covered(
    pixels: NDArray[np.int64], scale: float, count: int
) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Source pixels that new ones cover along one axis, each with how much of it they do."""
    first, last = pixels / scale, (pixels + 1) / scale
    parts = []
    for step in range(int(np.ceil(1.0 / scale)) + 1):
        source = np.floor(first).astype(np.int64) + step
        share = np.minimum(source + 1, last) - np.maximum(source, first)
        share = np.where(source < count, np.maximum(share, 0.0), 0.0)
        if share.max() > 1e-9:
            parts.append((np.minimum(source, count - 1), share))
    return parts
