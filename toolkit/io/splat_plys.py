"""Splat PLYs in the layout of 3DGS viewers.

They store opacity as a logit, scale as a logarithm, rotation as a quaternion wxyz and colour as the
coefficient f_dc of the constant spherical harmonic. Open3D stores linear scales in memory and
writes their logarithm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.io.atomic import write_bytes
from toolkit.io.compressed_ply import MIP_COMMENT, is_compressed_ply, read_compressed_ply
from toolkit.io.open3d_splats import read_with_open3d, write_with_open3d
from toolkit.io.splat_columns import Columns

# Comment in the header; see `Splats.pixel_filter`.
FILTER_COMMENT = "pixel_filter 0.1 compensated"
_MAX_HEADER = 8192

_BYTES = {
    name: size
    for size, names in {
        1: "char uchar int8 uint8",
        2: "short ushort int16 uint16",
        4: "int uint float int32 uint32 float32",
        8: "double float64",
    }.items()
    for name in names.split()
}


def read_ply(path: Path) -> Columns:
    """Read a splat PLY, which may be compressed as SuperSplat writes it.

    Raises:
        FormatError: it is not a PLY, or is truncated.
    """
    if is_compressed_ply(path):
        return read_compressed_ply(path)
    _check_length(path)
    return read_with_open3d(path)


def write_ply(
    path: Path, columns: Columns, extra: Mapping[str, NDArray], comments: Sequence[str] = ()
) -> None:
    """Write columns, additional columns [N] and comments of a line each.

    Raises:
        ValueError: an additional column has the wrong length.
        RunFolderError: the file cannot be written.
    """
    count = len(columns["positions"])
    added: Columns = {}
    for name, column in sorted(extra.items()):
        values = np.asarray(column)
        if values.shape != (count,):
            raise ValueError(f"{name} must have shape [{count}], got {list(values.shape)}")
        dtype = np.int32 if np.issubdtype(values.dtype, np.integer) else np.float32
        added[name] = values.astype(dtype)[:, None]
    write_with_open3d(path, columns | added)
    if comments:
        head, _, rest = path.read_bytes().partition(b"\nelement ")
        lines = "".join(f"\ncomment {line}" for line in comments).encode()
        write_bytes(path, head + lines + b"\nelement " + rest)


def is_filtered_ply(path: Path) -> bool:
    """Whether a PLY has a comment that its splats were fitted with a filter of pixels."""
    with path.open("rb") as file:
        header = file.read(_MAX_HEADER).partition(b"end_header")[0]
    return any(comment.encode() in header for comment in (FILTER_COMMENT, MIP_COMMENT))


def _check_length(path: Path) -> None:
    """Check that a binary PLY has the length given by its header, which Open3D does not check.

    Raises:
        FormatError: the file is shorter.
    """
    content = path.read_bytes()
    if not content.startswith(b"ply"):
        raise FormatError(f"{path} is not a PLY file; write it again")
    header, end, body = content.partition(b"end_header\n")
    words = [line.split() for line in header.decode("latin-1").splitlines()]
    if not end or ["format", "binary_little_endian", "1.0"] not in words:
        return
    expected, count = 0, 0
    for line in words:
        if line[:1] == ["element"] and len(line) == 3 and line[2].isdecimal():
            count = int(line[2])
        elif line[:1] == ["property"] and len(line) == 3 and line[1] in _BYTES:
            expected += count * _BYTES[line[1]]
    if len(body) < expected:
        raise FormatError(
            f"{path} is truncated: {len(body)} of {expected} bytes of data; write it again"
        )
