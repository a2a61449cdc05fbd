"""Stray Scanner: colour video, LiDAR depth and poses of an iPhone or iPad."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, FormatError
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.pairing import (
    ARKIT_UP,
    attach_poses,
    camera_of_matrix,
    check_times,
    folder_holding,
    numbered,
    unpaired,
)
from toolkit.io.images import read_depth_m
from toolkit.io.trajectories import pose_of_quaternion, text_lines
from toolkit.io.video import VideoFile

DEPTH_SCALE = 1000.0
_VIDEO, _ODOMETRY, _CAMERA = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")


def describe(path: Path) -> Recording:
    """Describe `rgb.mp4`, `depth/N.png`, `odometry.csv`, `camera_matrix.csv` and `confidence/`.

    Frames are the rows of `odometry.csv` with a depth image; row and depth image have the number of
    the video's frame. Colour is resized to the depth images. Depth with the confidence 0 counts as
    missing. The poses of ARKit become the ground truth; the app has turned them to our axes. Depth
    and intrinsics are those of the sensor, which is held sideways: the rotation by which players
    show the video upright is not applied.

    Source: `docs/format.md` and `OdometryEncoder.swift` of github.com/strayrobots/scanner.

    Raises:
        DatasetError: the folder has a different layout, or the video is damaged.
        FormatError: `odometry.csv` or `camera_matrix.csv` is malformed.
    """
    folder = folder_holding(path, (_VIDEO, _ODOMETRY, _CAMERA, "depth"), "Stray Scanner")
    depth = numbered(folder / "depth", r"(\d+)\.png")
    confidence = numbered(folder / "confidence", r"(\d+)\.png")
    rows = _odometry(folder / _ODOMETRY)
    video = folder / _VIDEO
    files = tuple(
        FrameFiles(time_s, video, depth[n], number=n, confidence=confidence.get(n))
        for n, (time_s, _) in rows.items()
        if n in depth
    )
    if not files:
        raise DatasetError(
            f"{folder} has no depth image with the number of a row of {_ODOMETRY}; copy the "
            f"recording again"
        )
    check_times(files, folder / _ODOMETRY)
    truth = attach_poses(files, [pose for n, (_, pose) in rows.items() if n in depth])
    height, width = read_depth_m(next(iter(depth.values())), DEPTH_SCALE).shape
    colour = camera_of_matrix(folder / _CAMERA, *VideoFile(video, rotated=False).size)
    # ARKit measures the principal point from the corner of the first pixel.
    colour = replace(colour, cx=colour.cx - 0.5, cy=colour.cy - 0.5)
    scale = width / colour.width, height / colour.height
    return Recording(
        name=folder.resolve().name,
        camera=colour.scaled(*scale, width, height),
        files=files,
        depth_scale=DEPTH_SCALE,
        ground_truth=truth.trajectory,
        up_world=ARKIT_UP,
        colour_may_be_larger=True,
        colour_camera=colour,
        rotated=False,
        flaws=unpaired(
            f"row(s) of {_ODOMETRY} without a depth image", [str(n) for n in rows if n not in depth]
        )
        + truth.flaws,
    )


def _odometry(path: Path) -> dict[int, tuple[float, NDArray[np.float64]]]:
    """Timestamp in seconds and pose [4, 4] by frame number, in the order of the file."""
    lines = text_lines(path)
    header = [word.strip() for word in next(lines, (1, ""))[1].split(",")]
    missing = [column for column in _COLUMNS if column not in header]
    if missing:
        raise FormatError(
            f"{path}, line 1: the header lacks {', '.join(missing)}; export the recording again"
        )
    order = [header.index(column) for column in _COLUMNS]
    rows = {}
    for number, line in lines:
        words = line.split(",")
        try:
            time_s, frame, *values = (float(words[i]) for i in order)
            index = int(frame)
        except (ValueError, IndexError, OverflowError) as error:
            raise FormatError(f"{path}, line {number}: {error}; fix or remove the line") from error
        rows[index] = (time_s, pose_of_quaternion(np.array(values[:3]), np.array(values[3:])))
    return rows
