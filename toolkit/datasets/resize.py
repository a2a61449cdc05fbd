"""Resizing of images: uniform scaling, then a centre crop."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.camera import Camera

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


def enlarge_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Enlarge a mask [H, W] to (width, height) by nearest neighbour."""
    enlarged = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(enlarged > 0)


class ImageGrid:
    """Pixel grid to which the images of one camera are resampled.

    All images use one grid, c' = (c + 0.5) s - 0.5. Colour is averaged over the area of each
    pixel. Inverse depth, which is linear on planes, is averaged over the part of the area that
    belongs to the surface at its centre. Labels are those of the source pixel that contains the
    centre; at half resolution this is a shift of a quarter of a pixel in a constant direction.

    Args:
        source: camera of the source images.
        size: target (width, height) in pixels.
        depth_offset_px: (x, y) in source pixels by which colour images, and labels, are offset
            from depth images.

    Raises:
        DatasetError: the target size is less than one pixel.
    """

    def __init__(
        self,
        source: Camera,
        size: tuple[int, int],
        depth_offset_px: tuple[float, float] = (0.0, 0.0),
    ) -> None:
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
        rows, columns = np.arange(top, top + height), np.arange(left, left + width)
        self._source_pixels = np.ix_(
            ((rows + 0.5) / scale_y).astype(np.int64), ((columns + 0.5) / scale_x).astype(np.int64)
        )
        offset_x, offset_y = depth_offset_px
        self._depth_rows = _Covered(rows, scale_y, source.height, offset_y)
        self._depth_columns = _Covered(columns, scale_x, source.width, offset_x)

    def colour(self, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample a colour image [H, W, 3] to this grid."""
        return np.ascontiguousarray(resize_colour(rgb, self._scaled_size)[self._crop])

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample a depth image [H, W] (m, 0 where missing) without mixing surfaces."""
        inverse = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
        middle = np.ascontiguousarray(
            inverse[self._depth_rows.middle][:, self._depth_columns.middle]
        )
        total, area, limit = np.zeros_like(middle), np.zeros_like(middle), _EDGE * middle
        distance, coverage = np.empty_like(middle), np.empty_like(middle)
        for rows, heights in self._depth_rows.parts:
            in_rows = inverse[rows]
            for columns, widths in self._depth_columns.parts:
                other = in_rows[:, columns]
                np.abs(np.subtract(other, middle, out=distance), out=distance)
                np.multiply(distance < limit, heights[:, None] * widths, out=coverage)
                area += coverage
                coverage *= other
                total += coverage
        return np.divide(area, total, out=np.zeros_like(area), where=total > 0)

    def nearest(self, image: NDArray) -> NDArray:
        """Resample a label image [H, W] to this grid by nearest neighbour."""
        return image[self._source_pixels]


class _Covered:
    """The source pixels that target pixels cover along one axis.

    Args:
        pixels: [N] target pixels.
        scale: target pixels per source pixel.
        count: number of source pixels.
        offset_px: of the target pixels, in source pixels.

    Attributes:
        middle: [N] the source pixels that contain the centres, or a slice of them.
        parts: the same of source pixels, and their coverage [N] by the target pixels.
    """

    def __init__(
        self, pixels: NDArray[np.int64], scale: float, count: int, offset_px: float
    ) -> None:
        first, last = pixels / scale - offset_px, (pixels + 1) / scale - offset_px
        middle = np.floor((pixels + 0.5) / scale - offset_px).astype(np.int64)
        own = np.clip(middle, 0, count - 1)
        self.middle = _sliced(own)
        self.parts = []
        for step in range(int(np.ceil(1.0 / scale)) + 1):
            source = np.floor(first).astype(np.int64) + step
            coverage = np.minimum(source + 1, last) - np.maximum(source, first)
            inside = (source >= 0) & (source < count) & (middle == own)
            coverage = np.where(inside, np.maximum(coverage, 0.0), 0.0)
            if coverage.max() > 1e-9:
                part = _sliced(np.clip(source, 0, count - 1)), coverage.astype(np.float32)
                self.parts.append(part)


def _sliced(indices: NDArray[np.int64]) -> NDArray[np.int64] | slice:
    """A slice of evenly spaced indices, which is read faster; others as they are."""
    steps = np.diff(indices)
    if not len(steps) or steps[0] <= 0 or (steps != steps[0]).any():
        return indices
    return slice(int(indices[0]), int(indices[-1]) + 1, int(steps[0]))
