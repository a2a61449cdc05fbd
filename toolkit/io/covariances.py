"""Files of pose covariances that accompany a trajectory file."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.io.atomic import write_bytes
from toolkit.io.trajectories import number_lines

PathLike = str | os.PathLike[str]
Array = NDArray[np.float64]

_TRIANGLE = np.triu_indices(6)
_AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
_HEADER = (
    "# Covariance of x in T_world_camera exp(x), x = (translation m, rotation rad) in the "
    "camera's frame:\n"
    "# the upper triangle, row by row.\n"
    "# timestamp_s "
    + " ".join(f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_TRIANGLE, strict=True))
    + "\n"
)


def write_covariances(path: PathLike, timestamps_s: Array, covariances: Array) -> None:
    """Write one line per pose: timestamp and upper triangle of its covariance (21 numbers).

    Args:
        timestamps_s: [N] timestamps of the trajectory.
        covariances: [N, 6, 6] symmetric.

    Raises:
        ValueError: the number of timestamps and covariances differ.
        RunFolderError: the file cannot be written.
    """
    if np.shape(covariances) != (len(timestamps_s), 6, 6):
        raise ValueError(
            f"covariances must have shape [{len(timestamps_s)}, 6, 6], "
            f"got {list(np.shape(covariances))}"
        )
    lines = [_HEADER]
    for time, covariance in zip(timestamps_s, covariances, strict=True):
        numbers = " ".join(f"{float(v) + 0.0:.9e}" for v in covariance[_TRIANGLE])
        lines.append(f"{time:.6f} {numbers}\n")
    write_bytes(path, "".join(lines).encode("ascii"))


def read_covariances(path: PathLike) -> tuple[Array, Array]:
    """Read timestamps [N] in seconds and covariances [N, 6, 6] written by `write_covariances`.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: a line does not consist of 22 finite numbers.
    """
    times, covariances = [], []
    for number, values in number_lines(path):
        if len(values) != 22 or not np.isfinite(values).all():
            raise FormatError(
                f"{path}, line {number}: expected a timestamp and 21 finite numbers, "
                f"got {len(values)} numbers; write the file again"
            )
        upper = np.zeros((6, 6))
        upper[_TRIANGLE] = values[1:]
        times.append(values[0])
        covariances.append(upper + np.triu(upper, 1).T)
    return np.array(times), np.array(covariances).reshape(-1, 6, 6)
