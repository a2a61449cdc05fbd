"""`.spz` files of the versions 2, 3 and 4.

Source: the description of the format in github.com/nianticlabs/spz. Axes are x right, y up, z
backward; positions have 24 bits, everything else a byte. The versions 2 and 3 are one stream,
compressed with gzip; rotations have 3 bytes in version 2 and 4 in version 3. Version 4 is
compressed with Zstandard. Open3D has the reader of the format's authors and writes version 4; it
neither converts axes nor reports damaged files.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.io.atomic import write_bytes
from toolkit.io.guarded.content import read_content
from toolkit.io.open3d_splats import read_with_open3d, write_with_open3d
from toolkit.io.smallest_three import split_largest
from toolkit.io.splat_columns import (
    Columns,
    check_count,
    harmonics_of,
    opacities_of,
    with_reversed_axes,
)

SpzVersion = Literal[2, 3, 4]

_MAGIC, _GZIP = b"NGSP", b"\x1f\x8b"
_FIRST_UNPACKED, _LATEST = 4, 4
_HEAD, _UNPACKED_HEAD = struct.Struct("<4sIIBBBB"), struct.Struct("<4sIIBBBBI12x")
# Flags: fitted with a filter of pixels that preserves opacity, as in Mip-Splatting; extensions.
_IS_FILTERED, _HAS_EXTENSIONS = 1, 2
_FLAGS_PLACE = 14
# Maximum size of extensions behind the splats.
_EXTENSION_BYTES = 2**24
# Code of zlib for the largest window and the head of gzip.
_GZIP_WINDOW = 31
# Bits behind the point of a position: 1/4096 m, and up to 2 km.
_FRACTION_BITS = 12
_COLOUR_SCALE = 0.15
# Level of gzip; the highest one takes many times as long for files that are hardly smaller.
_LEVEL = 6
# Bytes of a splat: position, opacity, colour and scales; a rotation by version.
_BYTES, _ROTATION_BYTES = 9 + 1 + 3 + 3, {1: 3, 2: 3, 3: 4, 4: 4}
# Harmonics are rounded to multiples of this, as the authors' writer does, since the low bits cannot
# be compressed: those of degree 1 and of the degrees above.
_STEP_1, _STEP = 8, 16


def read_spz(path: Path) -> Columns:
    """Read a `.spz` file, with its axes converted to those of a PLY.

    Raises:
        FormatError: it is damaged, or its version is not supported.
    """
    content = read_content(path)
    if content.startswith(_GZIP):
        _check_packed(path, content)
    elif content.startswith(_MAGIC):
        _check_unpacked(path, content)
    else:
        raise FormatError(f"{path} is not a .spz file; write it again")
    columns = read_with_open3d(path)
    # Open3D returns an empty cloud instead of an error.
    if not columns:
        raise FormatError(f"{path} is damaged; write it again")
    return with_reversed_axes(columns)


def is_filtered_spz(path: Path) -> bool:
    """Whether a `.spz` file says that its splats were fitted with a filter of pixels."""
    with path.open("rb") as file:
        packed = file.read(len(_GZIP)) == _GZIP
    with gzip.open(path) if packed else path.open("rb") as file:
        return bool(file.read(_HEAD.size)[_FLAGS_PLACE] & _IS_FILTERED)


def write_spz(
    path: Path, columns: Columns, is_filtered: bool = False, version: SpzVersion = 4
) -> None:
    """Write a `.spz` file; rows keep their order.

    Args:
        path: the file.
        columns: the splats.
        is_filtered: whether they were fitted with a filter of pixels, as in Mip-Splatting.
        version: version of the format.

    Raises:
        RunFolderError: a position is more than 2 km from the origin, or the file cannot be written.
    """
    if np.abs(columns["positions"]).max() >= 2.0 ** (23 - _FRACTION_BITS):
        raise RunFolderError(
            f"cannot write {path}: positions of a .spz file must be within 2 km of the origin; "
            "write a .ply"
        )
    reversed_ = with_reversed_axes(columns)
    flags = _IS_FILTERED if is_filtered else 0
    if version != _LATEST:
        write_bytes(path, _packed(reversed_, version, flags))
        return
    write_with_open3d(path, reversed_)
    if flags:
        content = bytearray(read_content(path))
        content[_FLAGS_PLACE] |= flags
        write_bytes(path, bytes(content))


def _packed(columns: Columns, version: int, flags: int) -> bytes:
    """The content of a file of version 2 or 3, from columns in its axes."""
    count, harmonics = len(columns["positions"]), harmonics_of(columns)
    fixed = np.rint(columns["positions"].astype(np.float64) * 2.0**_FRACTION_BITS)
    positions = fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    log_scales = np.log(columns["scale"].astype(np.float64))
    parts = (
        positions,
        _byte(255.0 * opacities_of(columns)),
        _byte(255.0 * (_COLOUR_SCALE * columns["f_dc"].astype(np.float64) + 0.5)),
        _byte(16.0 * (log_scales + 10.0)),
        _first_three(columns["rot"]) if version == 2 else _smallest_three(columns["rot"]),
        _packed_harmonics(harmonics),
    )
    degree = HARMONIC_COUNTS.index(harmonics.shape[1])
    head = _HEAD.pack(_MAGIC, version, count, degree, _FRACTION_BITS, flags, 0)
    # No time in the header, so that the same map gives the same file.
    content = head + b"".join(part.tobytes() for part in parts)
    return gzip.compress(content, _LEVEL, mtime=0)


def _first_three(rotations: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Version 2: bytes x, y, z of quaternions wxyz with w >= 0."""
    upright = np.where(rotations[:, :1] < 0, -rotations, rotations).astype(np.float64)
    return _byte(127.5 + 127.5 * upright[:, 1:])


def _smallest_three(rotations: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Version 3: the index of the largest of x, y, z, w, and a sign and 9 bits for each other."""
    largest, others = split_largest(np.roll(rotations, -1, axis=1))
    packed = largest.astype(np.uint32)
    sizes = np.rint(np.abs(others) * 2.0**0.5 * 511.0).clip(0, 511).astype(np.uint32)
    for k in range(3):
        sign = (others[:, k] < 0).astype(np.uint32)
        packed = packed << np.uint32(10) | sign << np.uint32(9) | sizes[:, k]
    return packed.astype("<u4")


def _packed_harmonics(harmonics: NDArray[np.floating]) -> NDArray[np.uint8]:
    steps = np.where(np.arange(harmonics.shape[1]) < HARMONIC_COUNTS[1], _STEP_1, _STEP)[:, None]
    bytes_ = np.rint(128.0 * harmonics.astype(np.float64) + 128.0)
    return _byte((bytes_ + steps // 2) // steps * steps)


def _byte(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    # Halves are rounded up, as other writers do.
    return np.floor(np.clip(values, 0.0, 255.0) + 0.5).astype(np.uint8)


def _check_packed(path: Path, content: bytes) -> None:
    """Check a file of the versions 1 to 3, without unpacking more than it announces."""
    stream = zlib.decompressobj(_GZIP_WINDOW)
    try:
        head = stream.decompress(content, _HEAD.size)
        if len(head) < _HEAD.size or not head.startswith(_MAGIC):
            raise FormatError(f"{path} is truncated, or not a .spz file; write it again")
        _, version, count, degree, _, flags, _ = _HEAD.unpack(head)
        _check_version(path, version, range(1, _FIRST_UNPACKED))
        check_count(path, count, len(content))
        expected = count * _row_bytes(path, version, degree)
        longest = expected + (_EXTENSION_BYTES if flags & _HAS_EXTENSIONS else 0)
        found = len(stream.decompress(stream.unconsumed_tail, longest + 1))
    except zlib.error as error:
        raise _truncated(path) from error
    if found > longest:
        raise FormatError(
            f"{path} contains more than the {expected} bytes of {count} splats; write it again"
        )
    if found < expected or not stream.eof:
        raise _truncated(path)


def _check_unpacked(path: Path, content: bytes) -> None:
    """Check a file of version 4, whose streams are listed behind its head."""
    version = int.from_bytes(content[4:8], "little")
    if len(content) >= 8 and version < _FIRST_UNPACKED:
        raise FormatError(
            f"{path}: a .spz file of version {version} must be compressed with gzip; write it "
            "again, or convert it to .ply"
        )
    if len(content) < _UNPACKED_HEAD.size:
        raise _truncated(path)
    _, version, count, degree, _, _, streams, place = _UNPACKED_HEAD.unpack_from(content)
    _check_version(path, version, range(_FIRST_UNPACKED, _LATEST + 1))
    if len(content) < place + 16 * streams:
        raise _truncated(path)
    sizes = np.frombuffer(content, "<u8", 2 * streams, place).reshape(-1, 2).tolist()
    if len(content) < place + 16 * streams + sum(packed for packed, _ in sizes):
        raise _truncated(path)
    check_count(path, count, len(content))
    expected = count * _row_bytes(path, version, degree)
    if sum(unpacked for _, unpacked in sizes) != expected:
        raise FormatError(
            f"{path} does not contain the {expected} bytes of {count} splats; write it again"
        )


def _check_version(path: Path, version: int, known: range) -> None:
    if version not in known:
        raise FormatError(
            f"{path} is a .spz file of version {version}, but versions up to {_LATEST} can be "
            "read; write an earlier version, or a .ply"
        )


def _row_bytes(path: Path, version: int, degree: int) -> int:
    if degree >= len(HARMONIC_COUNTS):
        raise FormatError(
            f"{path} has harmonics of degree {degree}, but degrees up to "
            f"{len(HARMONIC_COUNTS) - 1} can be read; write it with fewer"
        )
    # Version 1, which no program has written for long, has positions of half floats.
    position = 6 if version == 1 else 9
    return _BYTES - 9 + position + _ROTATION_BYTES[version] + 3 * HARMONIC_COUNTS[degree]


def _truncated(path: Path) -> FormatError:
    return FormatError(f"{path} is truncated; write it again")
