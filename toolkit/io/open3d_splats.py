"""Splat files that Open3D reads and writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.atomic import replacing
from toolkit.io.process_streams import silenced
from toolkit.io.splat_columns import Columns


def read_with_open3d(path: Path) -> Columns:
    """Read the columns of a splat file in the axes of the file.

    Raises:
        FormatError: Open3D cannot read it.
    """
    try:
        with silenced():
            point = open3d().t.io.read_point_cloud(str(path)).point
        # Every array is copied: if one of Open3D's own still exists at the end of the process,
        # Open3D prints statistics of its memory and changes the exit status to 1.
        return {name: point[name].numpy().copy() for name in point}
    except (RuntimeError, ValueError, IndexError) as error:
        raise FormatError(
            f"{path} cannot be read ({_first_line(error)}); write it again"
        ) from error


def write_with_open3d(path: Path, columns: Columns, header: str = "") -> None:
    """Write columns as the file format of the suffix, atomically.

    Args:
        path: the file.
        columns: its columns.
        header: lines for the header of a PLY, each after a line break.

    Raises:
        RunFolderError: the file cannot be written.
    """
    o3d = open3d()
    cloud = o3d.t.geometry.PointCloud()
    for name, values in columns.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values))
    size = sum(values.nbytes for values in columns.values())
    with replacing(path, size) as temporary, silenced():
        if not o3d.t.io.write_point_cloud(str(temporary), cloud):
            raise RunFolderError(f"cannot write {path}: free space there, or allow writing")
        if header:
            head, start, rest = temporary.read_bytes().partition(b"\nelement ")
            temporary.write_bytes(head + header.encode() + start + rest)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
