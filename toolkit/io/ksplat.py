"""Read `.ksplat` files of the viewer GaussianSplats3D.

Source: the source code of github.com/mkkellogg/GaussianSplats3D (`SplatBuffer`). A file has
sections. Compression level 0 stores floats; level 1 half floats, and positions of 16 bits relative
to the centres of buckets; level 2 also harmonics of a byte. Axes are those of the PLY that the file
was made from; there are no harmonics above degree 2.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.io.guarded.content import read_content
from toolkit.io.splat_columns import CONSTANT_HARMONIC, Columns, logits

_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
_HEADER = struct.Struct("<BB2xII4xIH2x12xff")
_SECTION = struct.Struct("<IIIIfH2xI4xIIH")
_MAX_DEGREE = 2
# Range of harmonics of level 2 if the header has zeros.
_HARMONIC_RANGE = 1.5
# Half of the range of 16 bits for positions, if a section has a zero.
_POSITION_RANGE = 32767
_FLOATS = {0: "<f4", 1: "<f2", 2: "<f2"}
_HARMONIC_TYPES = {0: "<f4", 1: "<f2", 2: "u1"}


@dataclass(frozen=True)
class _File:
    path: Path
    content: bytes
    level: int
    harmonic_range: tuple[float, float]

    def array(self, dtype: np.dtype | str, count: int, place: int) -> NDArray:
        """An array inside the file.

        Raises:
            FormatError: the file is shorter.
        """
        if place + count * np.dtype(dtype).itemsize > len(self.content):
            raise FormatError(f"{self.path} is truncated; write it again")
        return np.frombuffer(self.content, dtype, count, place)


@dataclass(frozen=True)
class _Section:
    """Numbers of a section's splats and of its buckets; those that are not full are last."""

    count: int
    capacity: int
    bucket_size: int
    bucket_count: int
    block_size_m: float
    bucket_bytes: int
    position_range: int
    full_buckets: int
    partial_buckets: int
    degree: int

    def centres_place(self, place: int) -> int:
        """The place of the buckets' centres in a section that begins at a place."""
        return place + 4 * self.partial_buckets

    def rows_place(self, place: int) -> int:
        """The place of the splats."""
        return self.centres_place(place) + self.bucket_bytes * self.bucket_count


def read_ksplat(path: Path) -> Columns:
    """Read a `.ksplat` file.

    Raises:
        FormatError: it is damaged, or its version is not supported.
    """
    content = read_content(path)
    if len(content) < _HEADER_BYTES:
        raise FormatError(f"{path} is truncated, or not a .ksplat file; write it again")
    major, minor, section_count, _, count, level, low, high = _HEADER.unpack_from(content)
    if (major, minor) != (0, 1) or level not in _FLOATS:
        raise FormatError(
            f"{path} is not a .ksplat file of version 0.1 with a compression level of 0 to 2 "
            f"(it has version {major}.{minor}, level {level}); write it again, or as a .ply"
        )
    file = _File(path, content, level, (low or -_HARMONIC_RANGE, high or _HARMONIC_RANGE))
    place = _HEADER_BYTES + _SECTION_BYTES * section_count
    parts = []
    for k in range(section_count):
        section = _section(file, _HEADER_BYTES + _SECTION_BYTES * k)
        if section.count:
            parts.append(_read_section(file, section, place))
        place = section.rows_place(place) + section.capacity * _row(file, section).itemsize
    if sum(len(part["positions"]) for part in parts) != count or not parts:
        raise FormatError(
            f"{path} does not contain the {count} splats of its header; write it again"
        )
    return _joined(parts)


def _section(file: _File, place: int) -> _Section:
    fields = _SECTION.unpack(file.array("u1", _SECTION.size, place).tobytes())
    section = _Section(*fields)
    if section.degree > _MAX_DEGREE:
        raise FormatError(
            f"{file.path} has harmonics of degree {section.degree}, but a .ksplat file has at most "
            f"{_MAX_DEGREE}; write it again"
        )
    return section


def _row(file: _File, section: _Section) -> np.dtype:
    """The layout of a splat."""
    number = _FLOATS[file.level]
    return np.dtype(
        [
            ("position", number if file.level == 0 else "<u2", 3),
            ("scale", number, 3),
            ("rotation", number, 4),
            ("rgba", "u1", 4),
            ("harmonics", _HARMONIC_TYPES[file.level], 3 * HARMONIC_COUNTS[section.degree]),
        ]
    )


def _read_section(file: _File, section: _Section, place: int) -> Columns:
    rows = file.array(_row(file, section), section.count, section.rows_place(place))
    positions = rows["position"].astype(np.float64)
    if file.level:
        limit = section.position_range or _POSITION_RANGE
        positions = (positions - limit) * (section.block_size_m / 2.0 / limit)
        positions += _bucket_centres(file, section, place)
    return {
        "positions": positions.astype(np.float32),
        "scale": rows["scale"].astype(np.float32),
        "rot": rows["rotation"].astype(np.float32),
        "f_dc": ((rows["rgba"][:, :3] / 255.0 - 0.5) / CONSTANT_HARMONIC).astype(np.float32),
        "opacity": logits(rows["rgba"][:, 3] / 255.0),
        "f_rest": _harmonics(file, rows["harmonics"], HARMONIC_COUNTS[section.degree]),
    }


def _bucket_centres(file: _File, section: _Section, place: int) -> NDArray[np.float32]:
    """The centre [count, 3] of each splat's bucket."""
    partial = file.array("<u4", section.partial_buckets, place)
    centres = file.array("<f4", 3 * section.bucket_count, section.centres_place(place))
    in_full = min(section.full_buckets * section.bucket_size, section.count)
    ends = in_full + np.cumsum(partial.astype(np.int64))
    index = np.arange(section.count)
    bucket = np.where(
        index < in_full,
        index // max(section.bucket_size, 1),
        section.full_buckets + np.searchsorted(ends, index, side="right"),
    )
    if bucket.max() >= section.bucket_count:
        raise FormatError(f"{file.path}: the buckets do not hold all splats; write it again")
    return centres.reshape(-1, 3)[bucket]


def _harmonics(file: _File, values: NDArray, count: int) -> NDArray[np.float32]:
    """Harmonics [N, count, 3]: in a file, those of one degree are in the order of the colours."""
    numbers = values.astype(np.float32)
    if file.level == 2:
        low, high = file.harmonic_range
        numbers = np.float32(low) + numbers / np.float32(255.0) * np.float32(high - low)
    harmonics = np.zeros((len(values), count, 3), np.float32)
    for first, end in pairwise(HARMONIC_COUNTS):
        if end <= count:
            by_colour = numbers[:, 3 * first : 3 * end].reshape(-1, 3, end - first)
            harmonics[:, first:end] = by_colour.transpose(0, 2, 1)
    return harmonics


def _joined(parts: list[Columns]) -> Columns:
    """The columns of all sections, with the harmonics of the highest degree."""
    width = max(part["f_rest"].shape[1] for part in parts)
    for part in parts:
        missing = width - part["f_rest"].shape[1]
        part["f_rest"] = np.pad(part["f_rest"], ((0, 0), (0, missing), (0, 0)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
