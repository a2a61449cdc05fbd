"""Images: their number of pixels is checked before a decoder allocates them."""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.io.guarded.content import DamagedError

# As many as a photograph of 8192x8192 pixels, 0.8 GB as numbers of 32 bits.
MAX_PIXELS = 2**26
# As many as such an image has with four channels of 16 bits.
MAX_IMAGE_BYTES = 2**29
# The header of a JPEG may follow a thumbnail, a profile of colours and notes.
_HEADER = 2**22
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_EXR, _DATA_WINDOW = b"\x76\x2f\x31\x01", b"dataWindow\0box2i\0"
# Markers of JPEG that start a frame, and those without content.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_EMPTY = frozenset({0x01, *range(0xD0, 0xD8)})


def decoded(content: bytes | NDArray[np.uint8], flags: int) -> NDArray:
    """Decode an image with OpenCV.

    Args:
        content: bytes of a file.
        flags: of `cv2.imdecode`.

    Raises:
        DamagedError: it is no image, is damaged, or has too many pixels.
    """
    data = np.frombuffer(content, np.uint8)
    check_pixels(data[:_HEADER].tobytes())
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise DamagedError("it is no image, or is truncated")
    return np.asarray(image)


def check_pixels(content: bytes, max_pixels: int = MAX_PIXELS) -> None:
    """Check the number of pixels that the header of a PNG, JPEG or EXR declares.

    Raises:
        DamagedError: it is larger than the limit.
    """
    size = image_size(content)
    if size is not None and size[0] * size[1] > max_pixels:
        raise DamagedError(f"it has {size[0]}x{size[1]} pixels, more than {max_pixels:,}")


def image_size(content: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a PNG, JPEG or EXR; None for others and without one."""
    if content.startswith(_EXR):
        return _exr_size(content)
    if content.startswith(_PNG) and len(content) >= 24:
        width, height = struct.unpack_from(">II", content, 16)
        return int(width), int(height)
    return _jpeg_size(content) if content.startswith(_JPEG) else None


def _exr_size(content: bytes) -> tuple[int, int] | None:
    place = content.find(_DATA_WINDOW)
    if place < 0 or len(content) < place + len(_DATA_WINDOW) + 20:
        return None
    left, top, right, bottom = struct.unpack_from("<4i", content, place + len(_DATA_WINDOW) + 4)
    return max(0, right - left + 1), max(0, bottom - top + 1)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    position = len(_JPEG)
    while position + 9 <= len(content) and content[position] == 0xFF:
        marker = content[position + 1]
        if marker in _FRAMES:
            height, width = struct.unpack_from(">HH", content, position + 5)
            return int(width), int(height)
        if marker == 0xFF:  # padding
            position += 1
        elif marker in _EMPTY:
            position += 2
        else:
            position += 2 + int.from_bytes(content[position + 2 : position + 4], "big")
    return None
