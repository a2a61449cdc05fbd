"""Pinhole camera with x right, y down, z forward and pixel centres at integer coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError

# Larger images would need tens of gigabytes: a frame takes about 1 kB per pixel while it is mapped.
MAX_PIXELS = 8192 * 4096


@dataclass(frozen=True)
class Camera:
    """Intrinsics of an undistorted pinhole camera.

    Attributes:
        fx, fy: focal lengths in pixels, > 0.
        cx, cy: principal point in pixels; the centre of the first pixel is (0, 0).
        width, height: image size in pixels, > 0, at most `MAX_PIXELS` together.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if not all(math.isfinite(n) for n in numbers) or self.fx <= 0 or self.fy <= 0:
            raise SettingsError(
                f"camera intrinsics must be finite with fx, fy > 0, got fx={self.fx} "
                f"fy={self.fy} cx={self.cx} cy={self.cy}"
            )
        if self.width < 1 or self.height < 1:
            raise SettingsError(f"camera size must be positive, got {self.width}x{self.height}")
        if self.width * self.height > MAX_PIXELS:
            raise SettingsError(
                f"an image of {self.width}x{self.height} pixels is too large; "
                f"the limit is {MAX_PIXELS} pixels (8192x4096)"
            )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    @property
    def focal(self) -> float:
        """Geometric mean of the focal lengths in pixels, sqrt(fx fy)."""
        return math.sqrt(self.fx * self.fy)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Intrinsic matrix K [3, 3]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def size_up_to(self, width: int) -> tuple[int, int] | None:
        """(width, height) of the image reduced to a width; None if it is not wider."""
        return (width, round(width * self.height / self.width)) if self.width > width else None

    def scaled(self, scale_x: float, scale_y: float, width: int, height: int) -> Camera:
        """Return the camera of the image resized by these factors to width x height.

        Pixel centres are at integers, so the principal point becomes c' = (c + 0.5) s - 0.5.
        """
        return Camera(
            fx=self.fx * scale_x,
            fy=self.fy * scale_y,
            cx=(self.cx + 0.5) * scale_x - 0.5,
            cy=(self.cy + 0.5) * scale_y - 0.5,
            width=width,
            height=height,
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Return the camera of the image cropped to start at pixel (left, top)."""
        return replace(self, cx=self.cx - left, cy=self.cy - top, width=width, height=height)

    def halved(self) -> Camera:
        """Return the camera of the next pyramid level.

        The level averages 2x2 pixels; an odd last row or column is dropped.
        """
        return self.scaled(0.5, 0.5, max(1, self.width // 2), max(1, self.height // 2))

    def rays(self, step: int = 1) -> NDArray[np.float64]:
        """Return the intersections [height, width, 3] of the pixels' rays with the plane z = 1.

        Args:
            step: use only every step-th pixel in each direction, starting at pixel step // 2.
        """
        x = (np.arange(self.width)[step // 2 :: step] - self.cx) / self.fx
        y = (np.arange(self.height)[step // 2 :: step] - self.cy) / self.fy
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x, grid_y, np.ones_like(grid_x)], axis=-1)

    def unproject(self, depth_m: NDArray, step: int = 1) -> NDArray[np.float64]:
        """Unproject a z-depth image to points [height, width, 3] in camera coordinates (m).

        Args:
            depth_m: [height, width] z-depths.
            step: unproject only every step-th pixel in each direction, as in `rays`.

        Raises:
            ValueError: the depth image has a different size.
        """
        if depth_m.shape != (self.height, self.width):
            raise ValueError(
                f"depth must have shape [{self.height}, {self.width}], got {list(depth_m.shape)}"
            )
        return self.rays(step) * depth_m[step // 2 :: step, step // 2 :: step, None]

    def project(self, points: NDArray) -> NDArray[np.float64]:
        """Project points [..., 3] with z > 0 to pixel coordinates [..., 2] (x, y)."""
        z = points[..., 2]
        return np.stack(
            [self.fx * points[..., 0] / z + self.cx, self.fy * points[..., 1] / z + self.cy],
            axis=-1,
        )
