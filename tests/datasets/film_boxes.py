"""Changes to the boxes of .mov and .mp4 files that OpenCV has written."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

Edit = Callable[[bytes, bytes], bytes]

# Boxes whose content is boxes.
PARENTS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", len(content) + 8, kind) + content


def edited(content: bytes, edit: Edit) -> bytes:
    """Boxes with the contents that `edit` returns, which is given type and content of each."""
    result, position = b"", 0
    while position < len(content):
        size, kind = struct.unpack_from(">I4s", content, position)
        inside = content[position + 8 : position + size]
        if kind in PARENTS:
            inside = edited(inside, edit)
        result += box(kind, edit(kind, inside))
        position += size
    return result


def change(path: Path, edit: Edit) -> None:
    """Rewrite a file with the contents that `edit` returns."""
    content = edited(path.read_bytes(), edit)
    assert content != path.read_bytes()
    path.write_bytes(content)


def turned_upright(height: int) -> Edit:
    """Rotation metadata of a phone that is held upright: 90 degrees clockwise."""

    def turn(kind: bytes, content: bytes) -> bytes:
        if kind != b"tkhd":
            return content
        matrix = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, height << 16, 0, 1 << 30)
        return content[:40] + matrix + content[76:]

    return turn
