"""COLMAP's model: `cameras.txt` and `images.txt`, or the same in binary.

Format: https://colmap.github.io/format.html. Models of cameras: `src/colmap/sensor/models.h`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, FormatError, SettingsError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.io.colmap_binary import camera_rows, image_rows
from toolkit.io.trajectories import pose_of_quaternion, text_lines
from toolkit.io.user_files import read_text

# Images list their points, thousands each.
_MAX_IMAGES_BYTES = 2**32


@dataclass(frozen=True)
class _Model:
    """Parameters of a model: how many focal lengths, where its distortion goes, fisheye or not."""

    focals: int
    distortion: tuple[int, ...] = ()
    fisheye: bool = False


# Positions of the distortion's parameters among OpenCV's: k1, k2, p1, p2, k3, ..., or k1 to k4 of a
# fisheye.
_MODELS = {
    "SIMPLE_PINHOLE": _Model(1),
    "PINHOLE": _Model(2),
    "SIMPLE_RADIAL": _Model(1, (0,)),
    "RADIAL": _Model(1, (0, 1)),
    "OPENCV": _Model(2, (0, 1, 2, 3)),
    "FULL_OPENCV": _Model(2, (0, 1, 2, 3, 4, 5, 6, 7)),
    "SIMPLE_RADIAL_FISHEYE": _Model(1, (0,), fisheye=True),
    "RADIAL_FISHEYE": _Model(1, (0, 1), fisheye=True),
    "OPENCV_FISHEYE": _Model(2, (0, 1, 2, 3), fisheye=True),
}


@dataclass(frozen=True)
class ColmapCamera:
    """A camera of a model, with pixel centres at integers.

    Attributes:
        camera: focal lengths, principal point and size.
        distortion: OpenCV's coefficients, 5, 8 or with `fisheye` 4; None without distortion.
        fisheye: whether they are of the model of Kannala and Brandt.
    """

    camera: Camera
    distortion: tuple[float, ...] | None
    fisheye: bool


@dataclass(frozen=True)
class ColmapImage:
    """An image of a model.

    Attributes:
        name: path relative to the folder of images.
        camera_id: key of its camera.
        T_world_camera: pose [4, 4]; NaN if it is not finite.
    """

    name: str
    camera_id: int
    T_world_camera: NDArray[np.float64]


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read `cameras.txt` or `cameras.bin`.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: a line is malformed or its camera model is not supported.
    """
    cameras = {}
    for place, (identifier, name, width, height, values) in _camera_rows(path):
        model = _MODELS.get(name)
        if model is None:
            raise FormatError(
                f"{place}: the camera model {name} is not supported; undistort the images with "
                f"`colmap image_undistorter`"
            )
        if identifier in cameras:
            raise FormatError(f"{place}: camera {identifier} is given twice; remove one")
        try:
            cameras[identifier] = _camera(model, values, width, height)
        except (ValueError, SettingsError) as error:
            raise FormatError(f"{place}: {error}; export the model again") from error
    return cameras


def _camera_rows(path: Path) -> Iterator[tuple[str, tuple[int, str, int, int, list[float]]]]:
    """Rows of cameras with the place of each in the file."""
    if path.suffix == ".bin":
        for row in camera_rows(path):
            yield f"{path}, camera {row[0]}", row
        return
    for number, line in text_lines(path):
        place = f"{path}, line {number}"
        try:
            identifier, name, width, height, *parameters = line.split()
            values = [float(word) for word in parameters]
            row = int(identifier), name, int(width), int(height), values
        except ValueError as error:
            raise FormatError(f"{place}: {error}; export the model again") from error
        yield place, row


def read_images(path: Path) -> list[ColmapImage]:
    """Read `images.txt` or `images.bin`.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: a line is malformed.
    """
    images, names = [], set()
    for pose, camera_id, name in image_rows(path) if path.suffix == ".bin" else _text_rows(path):
        if name in names:
            raise FormatError(f"{path}: image {name} is given twice; export the model again")
        names.add(name)
        values = np.array(pose)
        T_camera_world = pose_of_quaternion(values[4:], values[[1, 2, 3, 0]])
        finite = bool(np.isfinite(T_camera_world).all())
        T_world_camera = se3.inverse(T_camera_world) if finite else T_camera_world
        images.append(ColmapImage(name, camera_id, T_world_camera))
    return images


def _text_rows(path: Path) -> Iterator[tuple[list[float], int, str]]:
    for number, line in _image_lines(path):
        words = line.split(maxsplit=9)
        try:
            yield [float(word) for word in words[1:8]], int(words[8]), words[9].strip()
        except (ValueError, IndexError) as error:
            raise FormatError(
                f"{path}, line {number}: expected `id qw qx qy qz tx ty tz camera name`; export "
                f"the model again"
            ) from error


def _image_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines of images with their numbers; each is followed by a line of points, maybe empty."""
    try:
        lines = read_text(path, _MAX_IMAGES_BYTES).splitlines()
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read {path}: {error}; export the model again") from error
    points_follow = False
    for number, line in enumerate(lines, start=1):
        if points_follow:
            points_follow = False
        elif line.strip() and not line.startswith("#"):
            points_follow = True
            yield number, line


def _camera(model: _Model, values: list[float], width: int, height: int) -> ColmapCamera:
    count = model.focals + 2 + len(model.distortion)
    if len(values) != count:
        raise ValueError(f"the model has {count} parameters, not {len(values)}")
    fx, fy = values[0], values[model.focals - 1]
    cx, cy, *distortion = values[model.focals :]
    # COLMAP's pixels have their centre at 0.5.
    camera = Camera(fx, fy, cx - 0.5, cy - 0.5, width, height)
    if not any(distortion) and not model.fisheye:
        return ColmapCamera(camera, None, False)
    coefficients = [0.0] * (4 if model.fisheye else 8 if len(distortion) == 8 else 5)
    for place, value in zip(model.distortion, distortion, strict=True):
        coefficients[place] = value
    return ColmapCamera(camera, tuple(coefficients), model.fisheye)
