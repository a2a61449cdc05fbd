"""Orientation and focal length from the EXIF data of photos (CIPA DC-008)."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit.base.errors import DatasetError
from toolkit.io.guarded.content import check_regular
from toolkit.io.guarded.images import MAX_IMAGE_BYTES

# Diagonal of 35 mm film: the equivalent focal length gives the same diagonal field of view.
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)

_ORIENTATION, _EXIF = 0x0112, 0x8769
_FOCAL_LENGTH_MM, _EQUIVALENT_MM = 0x920A, 0xA405
_IMAGE_WIDTH, _PLANE_RESOLUTION, _PLANE_UNIT = 0xA002, 0xA20E, 0xA210
# Of the resolution of the focal plane; the default is inches.
_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


@dataclass(frozen=True)
class PhotoInfo:
    """Metadata of a photo.

    Attributes:
        size: width and height of the stored pixels.
        orientation: 1 to 8, how they are to be turned and mirrored; 1 leaves them as they are.
        focal_px: focal length in pixels, None if the metadata lack it.
    """

    size: tuple[int, int]
    orientation: int
    focal_px: float | None


def read_photo_info(path: Path) -> PhotoInfo:
    """Read size, orientation and focal length from the header of an image file.

    Raises:
        DatasetError: the file is missing or not an image.
    """
    from PIL import Image  # only photos need it

    try:
        check_regular(path, MAX_IMAGE_BYTES)
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            size, exif = image.size, image.getexif()
            orientation, details = exif.get(_ORIENTATION, 1), exif.get_ifd(_EXIF)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else str(error)
        raise DatasetError(
            f"cannot read image {path} ({reason}); check the path, or convert it to JPEG"
        ) from error
    return PhotoInfo(
        size, orientation if orientation in range(1, 9) else 1, _focal_px(details, size)
    )


def focal_of_equivalent(equivalent_mm: float, width: float, height: float) -> float:
    """Focal length in pixels of an image whose equivalent on 35 mm film is known."""
    return equivalent_mm / FILM_DIAGONAL_MM * math.hypot(width, height)


def _focal_px(details: Any, size: tuple[int, int]) -> float | None:
    """From the resolution of the sensor if it is known: the equivalent is rounded to 1 mm."""
    focal_mm, resolution = _number(details, _FOCAL_LENGTH_MM), _number(details, _PLANE_RESOLUTION)
    unit_mm = _UNITS_MM.get(details.get(_PLANE_UNIT, 2))
    if focal_mm and resolution and unit_mm:
        # The resolution is that of the original image, which may have been resized since.
        original = _number(details, _IMAGE_WIDTH) or size[0]
        return focal_mm * resolution / unit_mm * size[0] / original
    equivalent_mm = _number(details, _EQUIVALENT_MM)
    return focal_of_equivalent(equivalent_mm, *size) if equivalent_mm else None


def _number(details: Any, tag: int) -> float | None:
    """A positive number, or None. Cameras with lenses they do not know write 0."""
    try:
        value = float(details.get(tag, 0.0))
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return value if 0 < value < float("inf") else None
