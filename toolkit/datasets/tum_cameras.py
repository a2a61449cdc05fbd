"""Cameras of recordings in TUM's layout: from a file, or known by the recording's name."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from toolkit.datasets.folder import read_intrinsics
from toolkit.errors import DatasetError, SettingsError
from toolkit.geometry.camera import Camera
from toolkit.io.images import read_rgb
from toolkit.io.trajectories import number_lines

INTRINSICS = "intrinsics.yaml"
# That of ETH3D's SLAM benchmark: fx fy cx cy.
_ETH3D = "calibration.txt"
_DEPTH_SCALE = 5000.0


@dataclass(frozen=True)
class TumCamera:
    """Camera and images of a recording.

    Attributes:
        distortion, fisheye, readout_s: as in `Recording`.
        depth_scale: depth values per metre.
        mirrored: the y axis of the poses points up, as the negative focal length of ICL-NUIM says.
    """

    camera: Camera
    distortion: tuple[float, ...] | None = None
    depth_scale: float = _DEPTH_SCALE
    fisheye: bool = False
    readout_s: float | None = None
    mirrored: bool = False


# The calibrations that the benchmarks publish for their colour cameras; depth is registered to
# them. The images of freiburg3 are published undistorted. OpenLORIS is known by its lists.
OPENLORIS = TumCamera(Camera(611.451, 611.486, 433.204, 249.473, 848, 480), depth_scale=1000.0)
_BY_NAME = {
    r"freiburg1": TumCamera(
        Camera(517.3, 516.5, 318.6, 255.3, 640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    r"freiburg2": TumCamera(
        Camera(520.9, 521.0, 325.1, 249.7, 640, 480), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    r"freiburg3": TumCamera(Camera(535.4, 539.2, 320.1, 247.6, 640, 480)),
    r"bonn": TumCamera(
        Camera(542.823, 542.577, 315.594, 237.756, 640, 480),
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    ),
    r"(living|office)_?room|traj\d_(frei|loop)": TumCamera(
        Camera(481.2, 480.0, 319.5, 239.5, 640, 480), mirrored=True
    ),
}


def camera_of(folder: Path, path: Path, first: Path, openloris: bool) -> TumCamera:
    """The camera of a recording.

    Args:
        folder: of the recording.
        path: as the user specified it; names of symbolic links are considered, too.
        first: first colour image.
        openloris: whether the lists are those of OpenLORIS.

    Raises:
        DatasetError: no file contains it, and the name is unknown; or the file is malformed.
    """
    if (folder / INTRINSICS).exists():
        found = read_intrinsics(folder / INTRINSICS)
        return TumCamera(
            found.camera, found.distortion, found.depth_scale, found.fisheye, found.readout_s
        )
    if (folder / _ETH3D).exists():
        return TumCamera(_eth3d_camera(folder / _ETH3D, first))
    names = [one.name.lower() for f in (folder, path) for one in (f, f.absolute(), f.resolve())]
    for pattern, known in _BY_NAME.items():
        if any(re.search(pattern, name) for name in names):
            return known
    if openloris:
        return OPENLORIS
    raise DatasetError(
        f"the camera of {folder} is unknown; write {folder / INTRINSICS} with the keys fx, fy, "
        f"cx, cy, width, height and depth_scale (docs/guides/datasets.md)"
    )


def _eth3d_camera(file: Path, first: Path) -> Camera:
    rows = [values for _, values in number_lines(file)]
    if not rows or len(rows[0]) < 4:
        raise DatasetError(f"{file} must contain fx, fy, cx and cy; download it again")
    height, width = read_rgb(first).shape[:2]
    fx, fy, cx, cy = (float(value) for value in rows[0][:4])
    try:
        return Camera(fx, fy, cx, cy, width, height)
    except SettingsError as error:
        raise DatasetError(f"{file}: {error}; correct the value") from error
