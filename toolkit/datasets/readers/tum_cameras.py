"""Cameras of recordings in TUM's layout: from a file, or known by the recording's name."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.readers.folder import read_intrinsics
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


@dataclass(frozen=True)
class _Benchmark:
    """Recordings with one camera.

    Attributes:
        name: pattern of their names.
        camera: as the benchmark publishes it for its colour images, which depth is registered to.
        times_s: the first and last time of all recordings.
        pairs: whether one list names the colour and depth images.
    """

    name: str
    camera: TumCamera
    times_s: tuple[float, float]
    pairs: bool = False

    def misfit(self, first: Path, time_s: float, pairs: bool) -> str | None:
        """What of a recording with this name is not as in the benchmark, if anything is."""
        height, width = read_rgb(first).shape[:2]
        camera = self.camera.camera
        if (width, height) != camera.size:
            return f"images of {camera.width}x{camera.height}, not {width}x{height}"
        if not self.times_s[0] <= time_s <= self.times_s[1]:
            return f"times from {self.times_s[0]:.0f} to {self.times_s[1]:.0f} s, not {time_s:.0f}"
        return "one list of pairs of images, not two lists" if self.pairs and not pairs else None


# Freiburg was recorded in 2011 and 2012, Bonn in the winter of 2018; ICL-NUIM counts frames.
# The images of freiburg3 are published undistorted. OpenLORIS is known by its lists.
OPENLORIS = TumCamera(Camera(611.451, 611.486, 433.204, 249.473, 848, 480), depth_scale=1000.0)
_FREIBURG_S, _BONN_S, _COUNTED_S = (1.3e9, 1.35e9), (1.53e9, 1.56e9), (0.0, 1e4)
_BENCHMARKS = (
    _Benchmark(
        r"freiburg1",
        TumCamera(
            Camera(517.3, 516.5, 318.6, 255.3, 640, 480),
            (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
        ),
        _FREIBURG_S,
    ),
    _Benchmark(
        r"freiburg2",
        TumCamera(
            Camera(520.9, 521.0, 325.1, 249.7, 640, 480),
            (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
        ),
        _FREIBURG_S,
    ),
    _Benchmark(r"freiburg3", TumCamera(Camera(535.4, 539.2, 320.1, 247.6, 640, 480)), _FREIBURG_S),
    _Benchmark(
        r"bonn",
        TumCamera(
            Camera(542.823, 542.577, 315.594, 237.756, 640, 480),
            (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
        ),
        _BONN_S,
    ),
    _Benchmark(
        r"(living|office)_?room|traj\d_(frei|loop)",
        TumCamera(Camera(481.2, 480.0, 319.5, 239.5, 640, 480), mirrored=True),
        _COUNTED_S,
        pairs=True,
    ),
)


def camera_of(
    folder: Path, path: Path, first: tuple[float, Path], openloris: bool, pairs: bool
) -> TumCamera:
    """The camera of a recording.

    Args:
        folder: of the recording.
        path: as the user specified it; names of symbolic links are considered, too.
        first: time in seconds and file of the first colour image.
        openloris: whether the lists are those of OpenLORIS.
        pairs: whether one list names the colour and depth images.

    Raises:
        DatasetError: no file contains it, and no benchmark has the name and such data; or the file
            is malformed.
    """
    if (folder / INTRINSICS).exists():
        found = read_intrinsics(folder / INTRINSICS)
        return TumCamera(
            found.camera, found.distortion, found.depth_scale, found.fisheye, found.readout_s
        )
    if (folder / _ETH3D).exists():
        return TumCamera(_eth3d_camera(folder / _ETH3D, first[1]))
    names = [one.name.lower() for f in (folder, path) for one in (f, f.absolute(), f.resolve())]
    why = "is unknown"
    for one in _BENCHMARKS:
        match = next(filter(None, (re.search(one.name, name) for name in names)), None)
        if match is None:
            continue
        misfit = one.misfit(first[1], first[0], pairs)
        if misfit is None:
            return one.camera
        why = f"is unknown: {match[0]} is the name of a benchmark that has {misfit}"
        break
    if openloris:
        return OPENLORIS
    raise DatasetError(
        f"the camera of {folder} {why}; write {folder / INTRINSICS} with the keys fx, fy, "
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
