"""One camera for a recording whose frames have intrinsics of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.pairing import listed

# Recordings of phones have a focal length for each frame, because of the autofocus. A larger
# relative deviation from the median is an error.
MAX_FOCAL_DEVIATION = 0.02
# A smaller one is not worth a line.
_NOTABLE_DEVIATION = 1e-3
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class CommonCamera:
    """The median of the frames' intrinsics.

    Attributes:
        camera: median focal lengths and principal point.
        flaws: a line about their variation, if it is notable.
    """

    camera: Camera
    flaws: tuple[str, ...]


def common_camera(
    source: Path, cameras: Sequence[Camera], remedy: str = "record with fixed focus and zoom"
) -> CommonCamera:
    """Return the median of the intrinsics of all frames.

    Args:
        source: file that contains them, for messages.
        cameras: of the frames, at least one.
        remedy: of focal lengths that differ too much.

    Raises:
        DatasetError: the frames differ in size, or by more than 2 % in focal length.
    """
    sizes = sorted({camera.size for camera in cameras})
    if len(sizes) > 1:
        named = [f"{width}x{height}" for width, height in sizes]
        raise DatasetError(
            f"{source} has images of different sizes ({listed(named)}); use the frames of one "
            f"camera"
        )
    values = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras])
    median = np.median(values, axis=0)
    deviation = float(np.abs(values[:, :2] / median[:2] - 1.0).max())
    if not deviation <= MAX_FOCAL_DEVIATION:
        raise DatasetError(
            f"{source}: focal lengths of the frames differ by {100 * deviation:.1f} % from their "
            f"median; {remedy}"
        )
    fx, fy, cx, cy = (float(value) for value in median)
    flaw = (
        f"focal lengths of the frames differ by up to {100 * deviation:.1f} %; the median "
        f"{fx:.1f} px is used for all"
    )
    return CommonCamera(
        Camera(fx, fy, cx, cy, *sizes[0]), () if deviation < _NOTABLE_DEVIATION else (flaw,)
    )


def camera_of_depth(colour: Camera, size: tuple[int, int], depth_file: Path) -> Camera:
    """The camera of depth images of (width, height), which may be smaller than colour images.

    Raises:
        DatasetError: the aspect ratios differ.
    """
    width, height = size
    scale_x, scale_y = width / colour.width, height / colour.height
    if abs(scale_x - scale_y) > _ASPECT_TOLERANCE * scale_x:
        raise DatasetError(
            f"{depth_file} is {width}x{height}, but the colour images are "
            f"{colour.width}x{colour.height}; export both with the same aspect ratio"
        )
    return colour.scaled(scale_x, scale_y, width, height)
