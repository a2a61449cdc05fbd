"""Help for the format modules: find folders, pair files, attach poses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.base import FrameFiles
from toolkit.errors import DatasetError, FormatError, SettingsError
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.geometry.trajectory import Trajectory
from toolkit.io.trajectories import read_matrix

# Files named in one line about many; the rest are counted.
_NAMED_FILES = 3


@dataclass(frozen=True)
class Truth:
    """Poses attached to frames, and what was wrong with them.

    Attributes:
        trajectory: poses at the frames' timestamps, None where not one is usable.
        missing: a line about frames without a pose, if there are any.
        infinite: a line about frames whose pose is not finite, if there are any.
        bent: a line about frames whose pose is not a rigid motion, if there are any.
    """

    trajectory: Trajectory | None
    missing: tuple[str, ...] = ()
    infinite: tuple[str, ...] = ()
    bent: tuple[str, ...] = ()

    @property
    def flaws(self) -> tuple[str, ...]:
        """All three lines, for formats in which none of them is usual."""
        return self.missing + self.infinite + self.bent


def folder_holding(path: Path, names: tuple[str, ...], layout: str) -> Path:
    """The folder that holds all these names: `path`, or its only child folder that does.

    Raises:
        DatasetError: `path` is not there, or no such folder is.
    """
    if not path.exists():
        raise DatasetError(f"{path} does not exist; check the path")
    if not path.is_dir():
        raise DatasetError(f"{path} is a file; give the folder of the {layout} data set")
    if all((path / name).exists() for name in names):
        return path
    children = [c for c in sorted(path.iterdir()) if all((c / n).exists() for n in names)]
    if len(children) == 1:
        return children[0]
    if children:
        raise DatasetError(
            f"{path} holds {len(children)} {layout} sequences "
            f"({listed([c.name for c in children])}); give the path of one"
        )
    missing = next(name for name in names if not (path / name).exists())
    raise DatasetError(
        f"{path} has no {missing}, which a {layout} data set needs; check the path and the "
        f"data set's kind (layouts: docs/datasets.md)"
    )


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder by the number that the pattern's one group catches, ascending."""
    expression = re.compile(pattern)
    found = {}
    for file in folder.iterdir() if folder.is_dir() else ():
        match = expression.fullmatch(file.name)
        if match:
            found[int(match.group(1))] = file
    return dict(sorted(found.items()))


def unpaired(what: str, names: list[str]) -> tuple[str, ...]:
    """A flaw line about files that lack their counterpart, if there are any."""
    return (f"{len(names)} {what}: {listed(names)}",) if names else ()


def listed(names: list[str]) -> str:
    """The first few names, and how many more there are."""
    rest = len(names) - _NAMED_FILES
    return ", ".join(names[:_NAMED_FILES]) + (f" and {rest} more" if rest > 0 else "")


def pair_numbered(
    rgb: dict[int, Path], depth: dict[int, Path], labels: dict[int, Path], fps: float
) -> tuple[FrameFiles, ...]:
    """Frames for the numbers that have colour and depth; number n was taken at n / fps."""
    return tuple(
        FrameFiles(number / fps, rgb[number], depth[number], labels.get(number))
        for number in rgb
        if number in depth
    )


def pairing_flaws(rgb: dict, depth: dict, labels: dict) -> tuple[str, ...]:
    """Lines about colour without depth, depth without colour, and frames without labels."""
    unlabelled = [rgb[n].name for n in rgb if n in depth and n not in labels] if labels else []
    return (
        *unpaired("colour image(s) without depth", [rgb[n].name for n in rgb if n not in depth]),
        *unpaired("depth image(s) without colour", [depth[n].name for n in depth if n not in rgb]),
        *unpaired("frame(s) without the labels that others have", unlabelled),
    )


def attach_poses(files: tuple[FrameFiles, ...], poses: list[NDArray[np.float64] | None]) -> Truth:
    """Truth from one pose [4, 4] a frame; None and poses that are not rigid are gaps."""
    missing = [f.rgb.name for f, pose in zip(files, poses, strict=True) if pose is None]
    infinite, bent, times, kept = [], [], [], []
    for frame, pose in zip(files, poses, strict=True):
        if pose is None:
            continue
        if not np.isfinite(pose).all():
            infinite.append(frame.rgb.name)
        elif not se3.is_rigid(pose, tolerance=1e-2):
            bent.append(frame.rgb.name)
        else:
            times.append(frame.timestamp_s)
            # Text files round; the nearest rotation is what was meant.
            kept.append(se3.orthonormalise(pose))
    return Truth(
        trajectory=Trajectory(np.array(times), np.array(kept)) if kept else None,
        missing=unpaired("frame(s) without a ground-truth pose", missing),
        infinite=unpaired("frame(s) with a non-finite ground-truth pose", infinite),
        bent=unpaired("frame(s) whose ground-truth pose is not a rigid motion", bent),
    )


def camera_of_matrix(path: Path, width: int, height: int) -> Camera:
    """The camera of images of this size whose intrinsic matrix, 3x3 or 4x4, is in a text file.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: it holds no such matrix.
    """
    K = read_matrix(path)
    try:
        return Camera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)
    except SettingsError as error:
        raise FormatError(f"{path} must hold fx 0 cx / 0 fy cy / 0 0 1: {error}") from error
