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

from toolkit.base.errors import FormatError
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.io.compressed_ply import unpacked_splats
from toolkit.io.open3d_splats import write_with_open3d
from toolkit.io.ply_elements import read_elements
from toolkit.io.splat_columns import OWN_COLUMNS, Columns

# Comment in the header; see `Splats.pixel_filter`.
FILTER_COMMENT = "pixel_filter 0.1 compensated"
_MAX_HEADER = 8192
_COMMENT = "comment "

# The columns of several properties; all others are columns of their own.
_JOINED = {
    "positions": ("x", "y", "z"),
    "f_dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity": ("opacity",),
    "scale": ("scale_0", "scale_1", "scale_2"),
    "rot": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "normals": ("nx", "ny", "nz"),
}
_HARMONIC = "f_rest_"


def read_ply(path: Path) -> Columns:
    """Read a splat PLY, which may be compressed as SuperSplat writes it.

    Raises:
        FormatError: it is not a PLY, is truncated, or a column is missing.
    """
    elements = read_elements(path)
    rows = elements.get("vertex", np.empty(0))
    names = rows.dtype.names or ()
    if "packed_position" in names:
        return unpacked_splats(path, elements)
    columns = {
        column: _stacked(rows, properties)
        for column, properties in _JOINED.items()
        if set(properties) <= set(names)
    }
    if "scale" in columns:
        columns["scale"] = np.exp(columns["scale"])
    harmonics = [name for name in names if name.startswith(_HARMONIC)]
    if harmonics:
        columns["f_rest"] = _harmonics(path, rows, harmonics)
    used = {name for properties in _JOINED.values() for name in properties}
    for name in names:
        if name not in {*used, *harmonics, *OWN_COLUMNS}:
            column = rows[name].astype(rows[name].dtype.newbyteorder("="))
            columns[name] = column[:, None]
    return columns


def _stacked(rows: NDArray, names: Sequence[str]) -> NDArray[np.float32]:
    return np.stack([rows[name].astype(np.float32) for name in names], axis=1)


def _harmonics(path: Path, rows: NDArray, names: Sequence[str]) -> NDArray[np.float32]:
    """The harmonics [N, K, 3] of columns for red, then green, then blue."""
    expected = [3 * count for count in HARMONIC_COUNTS[1:]]
    if len(names) not in expected or set(names) != {f"{_HARMONIC}{k}" for k in range(len(names))}:
        raise FormatError(
            f"{path} has {len(names)} columns {_HARMONIC}N, instead of 0, "
            f"{', '.join(map(str, expected[:-1]))} or {expected[-1]}; write it again"
        )
    values = _stacked(rows, [f"{_HARMONIC}{k}" for k in range(len(names))])
    return values.reshape(len(rows), 3, -1).transpose(0, 2, 1)


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
    write_with_open3d(path, columns | added, "".join(f"\n{_COMMENT}{line}" for line in comments))


def read_ply_comments(path: Path) -> list[str]:
    """Return the comments in the header of a PLY."""
    with path.open("rb") as file:
        header = file.read(_MAX_HEADER).partition(b"end_header")[0].decode(errors="replace")
    return [line[len(_COMMENT) :] for line in header.splitlines() if line.startswith(_COMMENT)]
