"""Metadata of .mov and .mp4 files that FFmpeg does not pass on.

Apple's cameras write keys of the handler `mdta` in `moov/meta` and in the `meta` of the video
track: `keys` lists their names and `ilst` their values (QuickTime File Format, "Metadata").
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

EQUIVALENT_FOCAL_MM = "com.apple.quicktime.camera.focal_length.35mm_equivalent"

# Boxes that contain metadata, or boxes with metadata.
_CONTAINERS = (b"trak", b"udta", b"meta")
# Larger ones are not read: the index of an hour of film takes a few megabytes.
_MAX_MOVIE_BYTES = 1 << 28
# Well-known types of values: sizes and signs of integers follow from the type and the length.
_TEXT, _FLOATS, _UNSIGNED = 1, {23: ">f", 24: ">d"}, (22, 75, 76, 77, 78)


def read_metadata(path: Path) -> dict[str, str | float]:
    """Read the values of all metadata keys that are texts or numbers.

    Returns:
        Values by key; empty if the file has none, is damaged or of another format.
    """
    try:
        with path.open("rb") as file:
            return _of_box(_movie(file))
    except (OSError, struct.error):
        return {}


def _movie(file: BinaryIO) -> bytes:
    """Content of the box `moov`, which may follow the images; empty if there is none."""
    while len(header := file.read(8)) == 8:
        size, kind = struct.unpack(">I4s", header)
        skipped = size - 8
        if size == 1:
            skipped = struct.unpack(">Q", file.read(8))[0] - 16
        if size == 0 or skipped < 0:
            break
        if kind == b"moov":
            return file.read(skipped) if skipped <= _MAX_MOVIE_BYTES else b""
        file.seek(skipped, 1)
    return b""


def _of_box(content: bytes) -> dict[str, str | float]:
    """Metadata of a box and of the containers in it."""
    found: dict[str, str | float] = {}
    names: list[str] = []
    for kind, inside in _boxes(content):
        if kind == b"keys":
            names = _names(inside)
        elif kind == b"ilst":
            found |= _values(inside, names)
        elif kind in _CONTAINERS:
            # In MP4, a version comes before the boxes of `meta`.
            versioned = kind == b"meta" and inside[4:8] != b"hdlr"
            found |= _of_box(inside[4:] if versioned else inside)
    return found


def _boxes(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Type and content of consecutive boxes, up to the first damaged one."""
    position = 0
    while position + 8 <= len(content):
        size, kind = struct.unpack_from(">I4s", content, position)
        if size < 8 or position + size > len(content):
            return
        yield kind, content[position + 8 : position + size]
        position += size


def _names(content: bytes) -> list[str]:
    """Names of the box `keys`: version, count, and boxes whose type is the namespace."""
    return [name.decode("utf-8", "replace") for _, name in _boxes(content[8:])]


def _values(content: bytes, names: list[str]) -> dict[str, str | float]:
    """Values of the box `ilst`, whose boxes have the number of the key from 1 as type."""
    values: dict[str, str | float] = {}
    for number, item in _boxes(content):
        index = int.from_bytes(number, "big") - 1
        for kind, data in _boxes(item):
            value = _value(data) if kind == b"data" and len(data) >= 8 else None
            if value is not None and 0 <= index < len(names):
                values.setdefault(names[index], value)
    return values


def _value(data: bytes) -> str | float | None:
    """A value after its type and locale; None if it is neither text nor a number."""
    (kind,) = struct.unpack_from(">I", data)
    payload = data[8:]
    if kind == _TEXT:
        return payload.decode("utf-8", "replace")
    if kind in _FLOATS:
        return float(struct.unpack_from(_FLOATS[kind], payload)[0])
    if kind in _UNSIGNED or kind in (21, 65, 66, 67, 74):
        return float(int.from_bytes(payload, "big", signed=kind not in _UNSIGNED))
    return None
