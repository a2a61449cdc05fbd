"""Helpers for the dataset formats: find folders, pair files, attach poses."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, FormatError, SettingsError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.base import FrameFiles
from toolkit.io.trajectories import read_matrix
from toolkit.io.user_files import visible

Key = TypeVar("Key", int, str)

# From the axes of OpenGL's camera, y up and z back, to ours: T_world_camera = T @ OPENGL_AXES.
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
# The direction up of ARKit's worlds, by gravity.
ARKIT_UP = (0.0, 1.0, 0.0)
# Maximum number of files listed in one line; the rest are counted.
_NAMED_FILES = 3


@dataclass(frozen=True)
class Truth:
    """Ground-truth poses of the frames, and defects of them.

    Attributes:
        trajectory: poses at the timestamps of the frames, or None if no pose is valid.
        missing: a line about frames without a pose, if any.
        infinite: a line about frames with a non-finite pose, if any.
        not_rigid: a line about frames whose pose is not a rigid motion, if any.
    """

    trajectory: Trajectory | None
    missing: tuple[str, ...] = ()
    infinite: tuple[str, ...] = ()
    not_rigid: tuple[str, ...] = ()

    @property
    def flaws(self) -> tuple[str, ...]:
        """All lines, for formats in which each of them is a defect."""
        return self.missing + self.infinite + self.not_rigid


def folder_holding(path: Path, names: tuple[str, ...], layout: str) -> Path:
    """Return the folder that contains all names: `path` or the only such child folder.

    Args:
        path: folder of the dataset or its parent.
        names: files and folders that must exist.
        layout: name of the layout for error messages.

    Raises:
        DatasetError: `path` does not exist, or there is not exactly one such folder.
    """
    if not path.exists():
        raise DatasetError(f"{path} does not exist; check the path")
    if not path.is_dir():
        raise DatasetError(f"{path} is a file; specify the folder of the {layout} dataset")
    if all((path / name).exists() for name in names):
        return path
    children = [c for c in visible(path) if all((c / n).exists() for n in names)]
    if len(children) == 1:
        return children[0]
    if children:
        raise DatasetError(
            f"{path} contains {len(children)} {layout} sequences "
            f"({listed([c.name for c in children])}); specify the path of one"
        )
    missing = next(name for name in names if not (path / name).exists())
    raise DatasetError(
        f"{path} has no {missing}, which a {layout} dataset needs; check the path and the "
        f"kind of the dataset (layouts: docs/guides/datasets.md)"
    )


def folder_holding_any(
    path: Path, choices: Sequence[tuple[str, ...]], layout: str
) -> tuple[Path, tuple[str, ...]]:
    """As `folder_holding`, with the first of several sets of names that any folder contains.

    Raises:
        DatasetError: as of `folder_holding`, for the first set if no folder contains any.
    """
    places = [path, *(visible(path) if path.is_dir() else ())]
    for names in choices:
        if any(all((place / name).exists() for name in names) for place in places):
            return folder_holding(path, names, layout), names
    return folder_holding(path, choices[0], layout), choices[0]


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Return the files of a folder by the number in the pattern's only group, ascending.

    Raises:
        DatasetError: two files have the same number.
    """
    expression = re.compile(pattern)
    files = visible(folder) if folder.is_dir() else ()
    matches = ((expression.fullmatch(file.name), file) for file in files)
    found = by_key((int(match.group(1)), file) for match, file in matches if match)
    return dict(sorted(found.items()))


def by_key(files: Iterable[tuple[Key, Path]]) -> dict[Key, Path]:
    """Return files by what identifies their frame.

    Raises:
        DatasetError: two files have the same key.
    """
    found: dict[Key, Path] = {}
    for key, file in files:
        if key in found:
            raise DatasetError(
                f"{file.parent} contains both {found[key].name} and {file.name}; keep one of them"
            )
        found[key] = file
    return found


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key of a name by which frame2 comes before frame10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def is_number(stem: str) -> bool:
    """Whether a file name without suffix is a non-negative number, so that files sort by it."""
    return stem.replace(".", "", 1).isdecimal()


def in_order(names: Iterable[str]) -> list[str]:
    """Names of files without suffix in the order of the frames.

    They are sorted by value if all are non-negative numbers, such as times in seconds, otherwise by
    name with the numbers in it by value.
    """
    found = list(names)
    if all(is_number(name) for name in found):
        return sorted(found, key=float)
    return sorted(found, key=natural_key)


def unpaired(what: str, names: list[str]) -> tuple[str, ...]:
    """Return a line about files without counterpart, if any."""
    return (f"{len(names)} {what}: {listed(names)}",) if names else ()


def listed(names: list[str]) -> str:
    """Format the first names and the number of the others."""
    rest = len(names) - _NAMED_FILES
    return ", ".join(names[:_NAMED_FILES]) + (f" and {rest} more" if rest > 0 else "")


def pair_numbered(
    rgb: dict[int, Path], depth: dict[int, Path], labels: dict[int, Path], fps: float
) -> tuple[FrameFiles, ...]:
    """Pair colour and depth images by number; the timestamp of number n is n / fps."""
    return tuple(
        FrameFiles(number / fps, rgb[number], depth[number], labels.get(number))
        for number in rgb
        if number in depth
    )


def pairing_flaws(rgb: dict, depth: dict, labels: dict) -> tuple[str, ...]:
    """Return lines about colour without depth, depth without colour, and frames without labels."""
    unlabelled = [rgb[n].name for n in rgb if n in depth and n not in labels] if labels else []
    return (
        *unpaired("colour image(s) without depth", [rgb[n].name for n in rgb if n not in depth]),
        *unpaired("depth image(s) without colour", [depth[n].name for n in depth if n not in rgb]),
        *unpaired("frame(s) without the labels that others have", unlabelled),
    )


def associate(
    times_a: NDArray[np.float64], times_b: NDArray[np.float64], max_difference: float
) -> list[tuple[int, int]]:
    """Associate timestamps one to one, greedily by the smallest difference.

    Args:
        times_a, times_b: ascending timestamps.
        max_difference: maximum difference of a pair, in the same unit.

    Returns:
        Index pairs (a, b), ordered by a.
    """
    candidates = []
    for i, time in enumerate(times_a):
        low, high = np.searchsorted(times_b, [time - max_difference, time + max_difference])
        candidates += [(abs(times_b[j] - time), i, int(j)) for j in range(low, high)]
    used_a: set[int] = set()
    used_b: set[int] = set()
    pairs = []
    for _, i, j in sorted(candidates):
        if i not in used_a and j not in used_b:
            used_a.add(i)
            used_b.add(j)
            pairs.append((i, j))
    return sorted(pairs)


def check_times(files: tuple[FrameFiles, ...], place: Path) -> None:
    """Check that the times of frames increase.

    Args:
        place: file with the times.

    Raises:
        DatasetError: times repeat or run backwards.
    """
    late = [
        frame.name
        for frame, before in zip(files[1:], files, strict=False)
        if not frame.timestamp_s > before.timestamp_s
    ]
    if late:
        raise DatasetError(
            f"{place}: times repeat or run backwards at {listed(late)}; sort the rows, or move "
            "each recording to a folder of its own"
        )


def attach_poses(files: tuple[FrameFiles, ...], poses: list[NDArray[np.float64] | None]) -> Truth:
    """Build ground truth from one pose [4, 4] or None per frame; invalid poses are omitted."""
    missing = [f.name for f, pose in zip(files, poses, strict=True) if pose is None]
    infinite, not_rigid, times, kept = [], [], [], []
    for frame, pose in zip(files, poses, strict=True):
        if pose is None:
            continue
        if not np.isfinite(pose).all():
            infinite.append(frame.name)
        elif not se3.is_rigid(pose, tolerance=1e-2):
            not_rigid.append(frame.name)
        else:
            times.append(frame.timestamp_s)
            # Correct the rounding of text files.
            kept.append(se3.orthonormalise(pose))
    return Truth(
        trajectory=Trajectory(np.array(times), np.array(kept)) if kept else None,
        missing=unpaired("frame(s) without a ground-truth pose", missing),
        infinite=unpaired("frame(s) with a non-finite ground-truth pose", infinite),
        not_rigid=unpaired("frame(s) whose ground-truth pose is not a rigid motion", not_rigid),
    )


def camera_of_matrix(path: Path, width: int, height: int) -> Camera:
    """Read the camera of images of a given size from a text file with a 3x3 or 4x4 matrix.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: the file does not contain an intrinsic matrix.
    """
    K = read_matrix(path)
    try:
        return Camera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)
    except SettingsError as error:
        raise FormatError(f"{path} must contain fx 0 cx / 0 fy cy / 0 0 1: {error}") from error
