"""NumPy arrays: shape and type are compared with the size of the file before memory is used."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from toolkit.io.guarded.archive import MAX_MEMBER, Archive
from toolkit.io.guarded.content import DamagedError, PathLike, check_regular, damage

_SUFFIX = ".npy"
_HEADERS: dict[tuple[int, int], Callable[..., Any]] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_MAX_HEADER, _MAX_DIMENSIONS = 10_000, 16
# Zeros are packed to a thousandth.
_ANY_RATIO = math.inf
_CHUNK = 2**20


def read_array(path: PathLike, max_bytes: int = MAX_MEMBER) -> NDArray:
    """Read a `.npy` file.

    Raises:
        OSError: it cannot be read.
        DamagedError: it is no such file, is damaged, contains objects, or is too large.
    """
    check_regular(path, max_bytes)
    with open(path, "rb") as file:
        return _array(file, os.fstat(file.fileno()).st_size)


def read_arrays(
    path: PathLike, wanted: Callable[[str], bool] | None = None, max_bytes: int = MAX_MEMBER
) -> dict[str, NDArray]:
    """Read a `.npz` file.

    Args:
        wanted: whether to read the array of a name; all by default.
        max_bytes: limit of all that are read.

    Raises:
        OSError: it cannot be read.
        DamagedError: it is no such file, is damaged, contains objects, or is too large.
    """
    arrays, left = {}, max_bytes
    with Archive(path) as archive:
        for member in archive.names:
            name = member.removesuffix(_SUFFIX)
            if wanted is None or wanted(name):
                with archive.opened(member, left, _ANY_RATIO) as stream:
                    arrays[name] = _array(stream, archive.size(member))
                left -= arrays[name].nbytes
    return arrays


def _array(stream: IO[bytes], size: int) -> NDArray:
    """The array in a stream of this number of bytes."""
    with damage():
        version = np.lib.format.read_magic(stream)
        if version not in _HEADERS:
            raise DamagedError(f"an array is in version {version} of the format")
        shape, in_columns, dtype = _HEADERS[version](stream, max_header_size=_MAX_HEADER)
        left = size - stream.tell()
        if (
            dtype.hasobject
            or dtype.names
            or len(shape) > _MAX_DIMENSIONS
            or min(shape, default=0) < 0
        ):
            raise DamagedError(f"an array has the type {dtype} and the shape {shape}")
        if math.prod(shape) * dtype.itemsize != left:
            raise DamagedError(f"an array of {dtype} with shape {shape} has {left} bytes")
        values = np.empty(shape, dtype, order="F" if in_columns else "C")
        content = values.reshape(-1, order="A").view(np.uint8) if left else np.zeros(0, np.uint8)
        for start in range(0, left, _CHUNK):
            part = np.frombuffer(stream.read(min(_CHUNK, left - start)), np.uint8)
            content[start : start + len(part)] = part
        return values
