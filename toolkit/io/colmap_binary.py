"""COLMAP's binary model: `cameras.bin` and `images.bin`, as rows of the text model.

Format: `src/colmap/scene/reconstruction_io_binary.cc`. Numbers are little-endian. Files of rigs and
frames (COLMAP 3.12 and later) repeat the poses of the images for rigs of one camera.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from toolkit.base.errors import DatasetError, FormatError
from toolkit.io.guarded.content import read_content

# Name and number of parameters by the number of the camera model, of `src/colmap/sensor/models.h`.
_CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}
_BYTES_OF_POINT = 24


class _Reader:
    """Reads values of a file one after the other."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._at = 0
        try:
            self._content = read_content(path)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise DatasetError(f"cannot read {path}: {reason}; check the path") from error

    def values(self, layout: str) -> tuple[Any, ...]:
        try:
            found = struct.unpack_from(f"<{layout}", self._content, self._at)
        except struct.error as error:
            raise self.cut_off() from error
        self._at += struct.calcsize(f"<{layout}")
        return found

    def name(self) -> str:
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise self.cut_off()
        try:
            name = self._content[self._at : end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise FormatError(
                f"{self.path}: the name of an image is not text; export the model again"
            ) from error
        self._at = end + 1
        return name

    def skip(self, count: int) -> None:
        self._at += count
        if self._at > len(self._content):
            raise self.cut_off()

    def cut_off(self) -> FormatError:
        return FormatError(f"{self.path} ends too early; export the model again")


def camera_rows(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    """Yield identifier, name of the model, width, height and parameters of each camera.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: it ends too early or has an unknown camera model.
    """
    reader = _Reader(path)
    (count,) = reader.values("Q")
    for _ in range(count):
        identifier, model, width, height = reader.values("iiQQ")
        if model not in _CAMERA_MODELS:
            raise FormatError(
                f"{path}: the camera model {model} is not known; undistort the images with "
                f"`colmap image_undistorter`"
            )
        name, parameters = _CAMERA_MODELS[model]
        yield identifier, name, width, height, list(reader.values(f"{parameters}d"))


def image_rows(path: Path) -> Iterator[tuple[list[float], int, str]]:
    """Yield quaternion (w first) with translation, camera and name of each image.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: it ends too early, or a name is not text.
    """
    reader = _Reader(path)
    (count,) = reader.values("Q")
    for _ in range(count):
        _, *pose = reader.values("I7d")
        (camera,) = reader.values("I")
        name = reader.name()
        (points,) = reader.values("Q")
        reader.skip(points * _BYTES_OF_POINT)
        yield pose, camera, name
