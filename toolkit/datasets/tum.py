"""TUM RGB-D: colour, depth and motion capture with separate timestamps."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.pairing import (
    Truth,
    associate,
    attach_poses,
    folder_holding,
    listed,
    unpaired,
)
from toolkit.errors import DatasetError
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.io.trajectories import read_tum_lines, text_lines

# Maximum time difference of associated images, as in the benchmark's own tool.
MAX_DIFFERENCE_S = 0.02
DEPTH_SCALE = 5000.0


@dataclass(frozen=True)
class _Calibration:
    camera: Camera
    distortion: tuple[float, ...] | None


# The benchmark's calibration of each Kinect's colour camera; depth is registered to it.
# The images of freiburg3 are published undistorted.
CALIBRATIONS = {
    1: _Calibration(
        Camera(517.3, 516.5, 318.6, 255.3, 640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    2: _Calibration(
        Camera(520.9, 521.0, 325.1, 249.7, 640, 480), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    3: _Calibration(Camera(535.4, 539.2, 320.1, 247.6, 640, 480), None),
}


def describe(path: Path) -> Recording:
    """Describe a sequence folder or the only sequence in a folder.

    Colour and depth images are associated one to one by the smallest time difference, at most
    20 ms. A frame has the timestamp of its colour image and the interpolated pose at this time.

    Raises:
        DatasetError: the folder has a different layout, or its name does not identify the camera.
        FormatError: a line of a list file is malformed.
    """
    folder = folder_holding(path, ("rgb.txt", "depth.txt"), "TUM")
    calibration = _calibration(folder, path)
    rgb, rgb_flaws = _read_list(folder / "rgb.txt")
    depth, depth_flaws = _read_list(folder / "depth.txt")
    pairs = associate(rgb.times_s, depth.times_s, MAX_DIFFERENCE_S)
    files = tuple(FrameFiles(float(rgb.times_s[i]), rgb.files[i], depth.files[j]) for i, j in pairs)
    alone = sorted(set(range(len(rgb.files))) - {i for i, _ in pairs})
    truth = Truth(None)
    if (folder / "groundtruth.txt").exists():
        truth = attach_poses(files, _poses_at(folder / "groundtruth.txt", files))
    return Recording(
        name=folder.resolve().name,
        camera=calibration.camera,
        files=files,
        depth_scale=DEPTH_SCALE,
        ground_truth=truth.trajectory,
        distortion=calibration.distortion,
        flaws=rgb_flaws + depth_flaws + truth.infinite + truth.not_rigid,
        notes=unpaired(
            "colour image(s) without depth within 20 ms", [rgb.files[i].name for i in alone]
        )
        + truth.missing,
    )


@dataclass(frozen=True)
class _ImageList:
    times_s: NDArray[np.float64]
    files: list[Path]


def _read_list(path: Path) -> tuple[_ImageList, tuple[str, ...]]:
    """Read the `time file` lines of rgb.txt or depth.txt, sorted by time, and their defects."""
    entries = []
    for number, line in text_lines(path):
        words = line.split(maxsplit=1)
        try:
            entries.append((float(words[0]), path.parent / words[1]))
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}, line {number}: expected `time file`, got {line!r}; fix the line"
            ) from error
    times = [time for time, _ in entries]
    late = [
        file.name
        for (time, file), before in zip(entries[1:], times, strict=False)
        if time <= before
    ]
    flaws = (f"{path.name}: timestamps out of order at {listed(late)}",) if late else ()
    ordered = dict(sorted(entries, key=lambda entry: entry[0]))
    return _ImageList(np.array(list(ordered)), list(ordered.values())), flaws


def _poses_at(path: Path, files: tuple[FrameFiles, ...]) -> list[NDArray[np.float64] | None]:
    """Return the pose at the time of each frame, or None without one within 20 ms.

    Poses are interpolated: motion capture samples every 10 ms, and a fast turn covers a degree
    in this time.
    """
    poses = read_tum_lines(path)
    if len(poses.timestamps_s) == 0:
        return [None] * len(files)
    order = np.argsort(poses.timestamps_s, kind="stable")
    times = poses.timestamps_s[order]
    found: list[NDArray[np.float64] | None] = []
    for frame in files:
        right = int(np.clip(np.searchsorted(times, frame.timestamp_s), 1, len(times) - 1))
        after_s = frame.timestamp_s - times[[right - 1, right]]
        nearest = right - 1 + int(np.argmin(np.abs(after_s)))
        first, second = poses.T_world_camera[order[[right - 1, right]]]
        if np.abs(after_s).max() <= MAX_DIFFERENCE_S and after_s[0] > after_s[1]:
            fraction = np.clip(after_s[0] / (after_s[0] - after_s[1]), 0.0, 1.0)
            found.append(first @ se3.exp(fraction * se3.log(se3.inverse(first) @ second)))
        else:
            close = np.abs(after_s).min() <= MAX_DIFFERENCE_S
            found.append(poses.T_world_camera[order[nearest]] if close else None)
    return found


def _calibration(folder: Path, path: Path) -> _Calibration:
    for name in (folder.resolve().name, path.resolve().name):
        match = re.search(r"freiburg(\d)", name)
        if match and int(match.group(1)) in CALIBRATIONS:
            return CALIBRATIONS[int(match.group(1))]
    raise DatasetError(
        f"{folder}: the camera cannot be determined from the folder's name; include freiburg1, "
        f"freiburg2 or freiburg3 in the name, or convert it to a `folder` dataset with "
        f"intrinsics.yaml"
    )
