"""Record3D: .r3d files of an iPhone or iPad with LiDAR or the front camera.

`metadata` has `K` (3x3, column by column, of the first frame, for the size `w` x `h` of colour),
`perFrameIntrinsicCoeffs` (fx, fy, cx, cy of each frame, absent in early versions), `poses` (camera
to world, qx qy qz qw tx ty tz, with OpenGL's axes: y up, z back), `frameTimestamps` in seconds, and
`fps`. Source: the app's author in the issues 27, 33, 36, 64 and 83 of
github.com/marek-simonik/record3d.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.common_camera import CommonCamera, camera_of_depth, common_camera
from toolkit.datasets.pairing import ARKIT_UP, OPENGL_AXES, Truth, attach_poses, unpaired
from toolkit.io.record3d import EXPORTED_METADATA, Record3DFile
from toolkit.io.trajectories import pose_of_quaternion
from toolkit.io.user_files import visible

_FPS = 60.0


def describe(path: Path) -> Recording:
    """Describe a .r3d file, the folder with its content, or a folder that contains one .r3d file.

    The app's export of EXR and JPG files is such a folder, too.

    Frames without depth are left out, unless there is no depth at all. Colour is resized to smaller
    depth images, and depth with the confidence 0 counts as missing. The poses of ARKit become the
    ground truth; recordings of the front camera have none.

    Raises:
        DatasetError: the file is damaged, or its focal length changes by more than 2 %.
        DependencyError: lzfse is not installed.
    """
    file = Record3DFile(_file_at(path))
    with_depth = set(file.depth_frames)
    numbers = [n for n in file.colour_frames if n in with_depth or not with_depth]
    if not numbers:
        raise DatasetError(f"{file.path} has no frame with colour and depth; export it again")
    times, flaws = _timestamps(file, numbers)
    depth_path = file.path if with_depth else None
    files = tuple(
        FrameFiles(time, file.path, depth_path, number=n)
        for n, time in zip(numbers, times, strict=True)
    )
    common = _camera(file, numbers)
    truth = _truth(file, files)
    camera = common.camera
    if with_depth:
        height, width = file.depth_m(numbers[0]).shape
        camera = camera_of_depth(
            camera, (width, height), file.path / f"depth of frame {numbers[0]}"
        )
    alone = [str(n) for n in file.colour_frames if with_depth and n not in with_depth]
    return Recording(
        name=file.path.resolve().stem,
        camera=camera,
        files=files,
        depth_scale=1.0,
        ground_truth=truth.trajectory,
        up_world=ARKIT_UP,
        colour_may_be_larger=True,
        colour_camera=common.camera,
        container=file,
        flaws=unpaired("frame(s) without depth", alone) + truth.flaws + common.flaws + flaws,
    )


def _file_at(path: Path) -> Path:
    """The file at a path, or the only one in a folder."""
    names = ("metadata", EXPORTED_METADATA)
    if not path.is_dir() or any((path / name).exists() for name in names):
        return path
    inside = [file for file in visible(path) if file.suffix.lower() == ".r3d"]
    if len(inside) != 1:
        raise DatasetError(
            f"{path} contains {len(inside) or 'no'} .r3d file{'s' * bool(inside)} and no "
            f"{EXPORTED_METADATA}; specify the path of a .r3d file, or export EXR and JPG files"
        )
    return inside[0]


def _timestamps(file: Record3DFile, numbers: list[int]) -> tuple[list[float], tuple[str, ...]]:
    """Times of the frames in seconds, and a line if those of the file cannot be used."""
    recorded = file.metadata.get("frameTimestamps")
    if isinstance(recorded, list) and len(recorded) > numbers[-1]:
        try:
            times = [float(recorded[n]) for n in numbers]
        except (TypeError, ValueError):
            times = []
        if times and math.isfinite(sum(times)) and (np.diff(times) > 0).all():
            return times, ()
    fps = file.metadata.get("fps")
    valid = isinstance(fps, int | float) and 0 < fps < float("inf")
    rate = float(fps) if valid and fps else _FPS
    flaw = ("frameTimestamps are not ascending; timestamps are number / fps",)
    return [n / rate for n in numbers], flaw if recorded else ()


def _camera(file: Record3DFile, numbers: list[int]) -> CommonCamera:
    """The median camera of the colour images."""
    per_frame = file.metadata.get("perFrameIntrinsicCoeffs")
    if isinstance(per_frame, list) and len(per_frame) > numbers[-1]:
        values = [_numbers(file, "perFrameIntrinsicCoeffs", per_frame[n], 4) for n in numbers]
    else:
        K = _numbers(file, "K", file.metadata.get("K"), 9)
        values = [K[[0, 4, 6, 7]]]
    width, height = file.colour_size
    stated_width = file.metadata.get("w", width)
    scale = width / stated_width if isinstance(stated_width, int) and stated_width > 0 else 1.0
    try:
        # ARKit measures the principal point from the corner of the first pixel.
        cameras = [
            Camera(scale * fx, scale * fy, scale * cx - 0.5, scale * cy - 0.5, width, height)
            for fx, fy, cx, cy in (map(float, row) for row in values)
        ]
    except SettingsError as error:
        raise DatasetError(f"metadata in {file.path}: {error}; export it again") from error
    return common_camera(file.path, cameras)


def _truth(file: Record3DFile, files: tuple[FrameFiles, ...]) -> Truth:
    poses = file.metadata.get("poses")
    if not isinstance(poses, list) or not poses:
        return Truth(None)
    found: list[NDArray[np.float64] | None] = []
    for frame in files:
        number = frame.number or 0
        if number >= len(poses):
            found.append(None)
            continue
        values = _numbers(file, "poses", poses[number], 7)
        found.append(pose_of_quaternion(values[4:], values[:4]) @ OPENGL_AXES)
    return attach_poses(files, found)


def _numbers(file: Record3DFile, key: str, values: Any, count: int) -> NDArray[np.float64]:
    """An array of the metadata; numbers that are not finite are kept."""
    try:
        array = np.array(values, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.size != count:
        raise DatasetError(
            f"{key} of metadata in {file.path} must have {count} numbers; export it again"
        )
    return array
