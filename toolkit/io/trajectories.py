"""Trajectory files in the formats of TUM, Replica (NICE-SLAM) and Open3D (.log)."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io.atomic import write_bytes
from toolkit.io.user_files import read_text

PathLike = str | os.PathLike[str]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TimedPoses:
    """Unvalidated poses of a file: in file order, NaN where a pose is not finite.

    Attributes:
        timestamps_s: [N] float64, seconds.
        T_world_camera: [N, 4, 4] float64, camera to world, metres.
    """

    timestamps_s: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]


def read_tum(path: PathLike) -> Trajectory:
    """Read `time tx ty tz qx qy qz qw` lines (seconds, metres, camera to world).

    If consecutive lines have the same timestamp, the first is used; the ground truth of TUM
    fr2/desk contains such a pair.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: a line does not consist of eight finite numbers, or timestamps decrease.
    """
    poses = read_tum_lines(path)
    first = np.diff(poses.timestamps_s, prepend=-np.inf) != 0
    if not first.all():
        _log.warning("%s: ignored %d line(s) with repeated timestamps", path, (~first).sum())
    return _checked(path, poses.timestamps_s[first], poses.T_world_camera[first])


def read_tum_lines(path: PathLike) -> TimedPoses:
    """Read a TUM file like `read_tum`, but accept unsorted timestamps and non-finite poses.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: a line does not consist of eight numbers, or its timestamp is not finite.
    """
    times: list[float] = []
    poses: list[NDArray[np.float64]] = []
    for number, values in number_lines(path):
        if len(values) != 8 or not np.isfinite(values[0]):
            raise FormatError(
                f"{path}, line {number}: expected 8 numbers (time tx ty tz qx qy qz qw), "
                f"got {len(values)}; fix or remove the line"
            )
        times.append(float(values[0]))
        poses.append(pose_of_quaternion(values[1:4], values[4:8]))
    return TimedPoses(np.array(times), np.array(poses).reshape(-1, 4, 4))


def write_tum(path: PathLike, trajectory: Trajectory) -> None:
    """Write `time tx ty tz qx qy qz qw` lines; the output is byte-for-byte reproducible.

    Values have nine decimals (nanometres), so a round trip changes poses by about 1e-9.

    Raises:
        RunFolderError: the file cannot be written.
    """
    lines = ["# timestamp_s tx ty tz qx qy qz qw (camera to world, metres)\n"]
    for time, T in zip(trajectory.timestamps_s, trajectory.T_world_camera, strict=True):
        values = [*T[:3, 3], *se3.quaternion_xyzw(T[:3, :3])]
        # Adding zero turns -0.0, which would be printed with its sign, into 0.0.
        numbers = " ".join(f"{round(float(v), 9) + 0.0:.9f}" for v in values)
        lines.append(f"{time:.6f} {numbers}\n")
    write_bytes(path, "".join(lines).encode("ascii"))


def read_matrix_lines(path: PathLike) -> NDArray[np.float64]:
    """Read poses [N, 4, 4] from lines of 16 numbers (row-major), as in Replica's `traj.txt`.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: a line does not consist of 16 numbers.
    """
    rows = []
    for number, values in number_lines(path):
        if len(values) != 16:
            raise FormatError(
                f"{path}, line {number}: expected 16 numbers (a 4x4 matrix, row by row), "
                f"got {len(values)}; fix or remove the line"
            )
        rows.append(values)
    return np.array(rows, dtype=np.float64).reshape(-1, 4, 4)


def read_matrix(path: PathLike) -> NDArray[np.float64]:
    """Read a text file that contains a 4x4 or 3x3 matrix; infinite entries are allowed.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: the content is not such a matrix.
    """
    rows = [values for _, values in number_lines(path)]
    side = len(rows)
    if side not in (3, 4) or any(len(row) != side for row in rows):
        raise FormatError(
            f"{path} must contain a 4x4 or 3x3 matrix, one row per line; export it again"
        )
    return np.array(rows)


def text_lines(path: PathLike) -> Iterator[tuple[int, str]]:
    """Yield the non-empty lines of a text file without # comments, with line numbers from 1.

    Raises:
        DatasetError: the file cannot be read.
    """
    try:
        text = read_text(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or f"not a text file ({error})"
        raise DatasetError(f"cannot read {path}: {reason}; check the path") from error
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0].strip()
        if content:
            yield number, content


def number_lines(path: PathLike) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield the numbers of each non-empty line, with line numbers from 1.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: a token is not a number.
    """
    for number, line in text_lines(path):
        try:
            values = np.array([float(word) for word in line.replace(",", " ").split()])
        except ValueError as error:
            raise FormatError(f"{path}, line {number}: {error}; fix or remove the line") from error
        yield number, values


def pose_of_quaternion(translation_m: NDArray, quaternion_xyzw: NDArray) -> NDArray[np.float64]:
    """A pose [4, 4] from a line of a file; NaN if it is not finite or its quaternion is zero."""
    finite = np.isfinite(translation_m).all() and np.isfinite(quaternion_xyzw).all()
    if not finite or np.linalg.norm(quaternion_xyzw) < 1e-6:
        return np.full((4, 4), np.nan)
    R = se3.rotation_from_quaternion_xyzw(quaternion_xyzw)
    return se3.from_rotation_translation(R, translation_m)


def _checked(path: PathLike, times_s: NDArray, poses: NDArray) -> Trajectory:
    try:
        return Trajectory(times_s, poses)
    except FormatError as error:
        raise FormatError(f"{path}: {error}; correct the file") from error
