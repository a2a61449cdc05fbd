"""TUM RGB-D: colour, depth and motion capture with separate timestamps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.geometry import se3
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.pairing import (
    Truth,
    associate,
    attach_poses,
    folder_holding_any,
    listed,
    unpaired,
)
from toolkit.datasets.readers.tum_cameras import camera_of
from toolkit.io.trajectories import read_tum_lines, text_lines

# Maximum time difference of associated images, as in the benchmark's own tool.
MAX_DIFFERENCE_S = 0.02
# Lists of colour and of depth images: TUM's and OpenLORIS'. ICL-NUIM has one list of pairs.
_LISTS, _OPENLORIS = ("rgb.txt", "depth.txt"), ("color.txt", "aligned_depth.txt")
_PAIRS = ("associations.txt",)
# Frames per second of lists whose times are the numbers of the frames, as ICL-NUIM's are.
_FPS = 30.0
# From a y axis that points up to one that points down.
_FLIP = np.diag([1.0, -1.0, 1.0, 1.0])


def describe(path: Path) -> Recording:
    """Describe a sequence folder or the only sequence in a folder.

    Colour and depth images are associated one to one by the smallest time difference, at most
    20 ms. A frame has the timestamp of its colour image and the interpolated pose at this time.
    The camera is that of `intrinsics.yaml`, of ETH3D's `calibration.txt`, or of the benchmark in
    the name.

    Raises:
        DatasetError: the folder has a different layout, or its camera is unknown.
        FormatError: a line of a list file is malformed.
    """
    folder, names = folder_holding_any(path, (_LISTS, _OPENLORIS, _PAIRS), "TUM")
    if names == _PAIRS:
        rgb, depth = _read_pairs(folder / names[0])
        flaws: tuple[str, ...] = ()
    else:
        (rgb, rgb_flaws), (depth, depth_flaws) = (_read_list(folder / name) for name in names)
        flaws = rgb_flaws + depth_flaws
    if not rgb.files:
        raise DatasetError(f"{folder / names[0]} lists no images; check the path")
    first = float(rgb.times_s[0]), rgb.files[0]
    known = camera_of(folder, path, first, names == _OPENLORIS, names == _PAIRS)
    pairs = associate(rgb.times_s, depth.times_s, MAX_DIFFERENCE_S)
    if not pairs:
        raise DatasetError(
            f"{folder}: no colour image has depth within {1e3 * MAX_DIFFERENCE_S:.0f} ms, "
            f"{_span(names[0], rgb)} and {_span(names[-1], depth)}; correct the times"
        )
    files = tuple(FrameFiles(float(rgb.times_s[i]), rgb.files[i], depth.files[j]) for i, j in pairs)
    alone = sorted(set(range(len(rgb.files))) - {i for i, _ in pairs})
    truth, file = Truth(None), _truth_file(folder)
    if file is not None:
        truth = attach_poses(files, _poses_at(file, files, rgb.interval_s, known.mirrored))
    return Recording(
        name=folder.resolve().name,
        camera=known.camera,
        files=files,
        depth_scale=known.depth_scale,
        ground_truth=truth.trajectory,
        distortion=known.distortion,
        fisheye=known.fisheye,
        readout_s=known.readout_s,
        flaws=flaws + truth.infinite + truth.not_rigid,
        notes=unpaired(
            "colour image(s) without depth within 20 ms", [rgb.files[i].name for i in alone]
        )
        + truth.missing,
    )


def _span(name: str, images: _ImageList) -> str:
    """The times of a list, for messages."""
    if not images.files:
        return f"{name} lists no images"
    return f"{name} has times from {images.times_s[0]:.3f} to {images.times_s[-1]:.3f} s"


def _truth_file(folder: Path) -> Path | None:
    """The file of the ground truth; ICL-NUIM's is `NAME.gt.freiburg`."""
    if (folder / "groundtruth.txt").exists():
        return folder / "groundtruth.txt"
    return next(iter(sorted(folder.glob("*.gt.freiburg"))), None)


@dataclass(frozen=True)
class _ImageList:
    """Images by time. `interval_s` is that of one unit of the times in the files of a recording."""

    times_s: NDArray[np.float64]
    files: list[Path]
    interval_s: float = 1.0


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


def _read_pairs(path: Path) -> tuple[_ImageList, _ImageList]:
    """Read lines of `time file time file`, depth and colour in any order."""
    colour: list[tuple[float, Path]] = []
    depth: list[tuple[float, Path]] = []
    for number, line in text_lines(path):
        words = line.split()
        try:
            entries = [
                (float(words[k]), path.parent / words[k + 1].removeprefix("./")) for k in (0, 2)
            ]
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}, line {number}: expected `time file time file`, got {line!r}; fix the line"
            ) from error
        first_is_depth = "depth" in words[1].lower()
        depth.append(entries[not first_is_depth])
        colour.append(entries[first_is_depth])
    colour.sort(), depth.sort()
    times = np.array([time for time, _ in colour])
    numbers = len(times) > 1 and bool(
        np.all(times == np.round(times)) and np.median(np.diff(times)) == 1
    )
    interval_s = 1.0 / _FPS if numbers else 1.0
    lists = [
        _ImageList(
            np.array([time for time, _ in entries]) * interval_s,
            [file for _, file in entries],
            interval_s,
        )
        for entries in (colour, depth)
    ]
    return lists[0], lists[1]


def _poses_at(
    path: Path, files: tuple[FrameFiles, ...], interval_s: float, mirrored: bool
) -> list[NDArray[np.float64] | None]:
    """Return the pose at the time of each frame, or None without one within 20 ms.

    Poses are interpolated: motion capture samples every 10 ms, and a fast turn covers a degree
    in this time.
    """
    poses = read_tum_lines(path)
    if len(poses.timestamps_s) == 0:
        return [None] * len(files)
    order = np.argsort(poses.timestamps_s, kind="stable")
    times = poses.timestamps_s[order] * interval_s
    T_world_camera = poses.T_world_camera[order]
    if mirrored:
        T_world_camera = _FLIP @ T_world_camera @ _FLIP
    found: list[NDArray[np.float64] | None] = []
    for frame in files:
        right = int(np.clip(np.searchsorted(times, frame.timestamp_s), 1, len(times) - 1))
        after_s = frame.timestamp_s - times[[right - 1, right]]
        nearest = right - 1 + int(np.argmin(np.abs(after_s)))
        first, second = T_world_camera[[right - 1, right]]
        if np.abs(after_s).max() <= MAX_DIFFERENCE_S and after_s[0] > after_s[1]:
            fraction = np.clip(after_s[0] / (after_s[0] - after_s[1]), 0.0, 1.0)
            found.append(se3.interpolated(first, second, fraction))
        else:
            close = np.abs(after_s).min() <= MAX_DIFFERENCE_S
            found.append(T_world_camera[nearest] if close else None)
    return found
