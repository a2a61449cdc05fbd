"""Images, arrays and archives that are crafted to harm their reader, from valid ones.

`tests/io/guarded` has more of each container.
"""

from __future__ import annotations

import io
import random
import struct
import zipfile
import zlib
from functools import cache

import numpy as np

from benchmarks.inputs.hostile_documents import Edit

_WORDS = {"-1": 0xFFFFFFFF, "2^31-1": 0x7FFFFFFF, "-2^31": 0x80000000, "2^24": 2**24, "0": 0}


def binary_edits() -> dict[str, Edit]:
    """Changes of any content."""
    edits: dict[str, Edit] = {
        f"{name} for a word of the head": _with_word(value) for name, value in _WORDS.items()
    }
    return edits | {
        "empty": lambda *_: b"",
        "a byte": lambda *_: b"\0",
        "1 MB of zeros": lambda *_: bytes(2**20),
        "1 MB of 255": lambda *_: b"\xff" * 2**20,
        "noise": lambda _, chance: chance.randbytes(2**16),
        "half of it": lambda content, _: content[: len(content) // 2],
        "all but a byte": lambda content, _: content[:-1],
        "twice": lambda content, _: content * 2,
        "another format": lambda *_: _zip({"a": b"b"}),
    }


def png_edits() -> dict[str, Edit]:
    """Changes of PNG images."""

    def headed(values: bytes, offset: int = 0) -> Edit:
        """Other values in the first chunk, and its checksum corrected."""

        def edit(content: bytes, _: random.Random) -> bytes:
            body = bytearray(content[16:29])
            body[offset : offset + len(values)] = values
            return content[:8] + _chunk(b"IHDR", bytes(body)) + content[33:]

        return edit

    return {
        "60000x60000 pixels": headed(struct.pack(">II", 60_000, 60_000)),
        "2^31 pixels wide": headed(struct.pack(">II", 2**31 - 1, 2**31 - 1)),
        "0x0 pixels": headed(struct.pack(">II", 0, 0)),
        "64 bits": headed(b"\x40", 8),
        "palette without colours": headed(b"\x08\x03", 8),
        "pixels of 1 GB": lambda content, _: content[:33] + _chunk(b"IDAT", _packed_zeros()),
        "a chunk of 4 GB": lambda content, _: content[:33] + b"\xff\xff\xff\xffIDAT" + content[41:],
    }


def array_edits() -> dict[str, Edit]:
    """Changes of `.npy` files."""

    def headed(header: str) -> Edit:
        text = header.encode() + b"\n"
        start = b"\x93NUMPY\x02\0" + struct.pack("<I", len(text))
        return lambda *_: start + text + bytes(64)

    def saved(values: object) -> Edit:
        stream = io.BytesIO()
        np.save(stream, np.asarray(values))
        return lambda *_: stream.getvalue()

    form = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}"
    shapes = ("(1000000000000,)", "(4294967296, 4294967296)", "(-1,)", "(16.5,)", "(True,)", "16")
    types = ("'O'", "'<U1000000000'", "'V0'", "[('a', '<f4')]", "'<c8'", "'zz'", "'<M8[s]'")
    edits = {f"shape {shape}": headed(form.format("'<f4'", shape)) for shape in shapes}
    edits |= {f"type {dtype}": headed(form.format(dtype, "(16,)")) for dtype in types}
    return edits | {
        "parentheses in the header": headed("(" * 5000),
        "a program as the header": headed("__import__('os').abort()"),
        "NaN": saved(np.full((4, 4), np.nan, np.float32)),
        "a number": saved(7),
        "a sequence of the terminal": saved(["\x1b[31m"]),
        "2^63 as numbers": saved(np.full(4, 2**63, np.uint64)),
        "five dimensions": saved(np.zeros((1, 2, 1, 2, 1))),
    }


def archive_edits() -> dict[str, Edit]:
    """Changes of zip archives as a whole."""

    def flags(place: int, at: int, value: bytes) -> Edit:
        # In the local header, and in the list at the end.
        def edit(content: bytes, _: random.Random) -> bytes:
            changed = bytearray(content)
            for magic, offset in ((b"PK\x03\x04", place), (b"PK\x01\x02", at)):
                start = changed.find(magic)
                changed[start + offset : start + offset + len(value)] = value
            return bytes(changed)

        return edit

    many = {f"{k}": b"" for k in range(100_000)}
    return {
        "encrypted": flags(6, 8, b"\x01\0"),
        "method 99": flags(8, 10, b"\x63\0"),
        "a wrong checksum": flags(14, 16, b"\x12\x34\x56\x78"),
        "a member of 4 GB declared": flags(22, 24, b"\xfe\xff\xff\xff"),
        "a name of 64 KB": flags(26, 28, b"\xff\xff"),
        "zeros of 1 GB in a member": lambda content, _: with_member(
            content, next(iter(members(content)), "a"), bytes(2**30)
        ),
        "paths above": lambda content, _: _zip(members(content) | {"../../a": b"", "/a": b""}),
        "100,000 members": lambda content, _: _zip(members(content) | many),
        "no members": lambda *_: _zip({}),
    }


def members(content: bytes) -> dict[str, bytes]:
    """The members of an archive; empty for other content."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    except zipfile.BadZipFile:
        return {}


def with_member(content: bytes, name: str, changed: bytes) -> bytes:
    """An archive with another content of a member."""
    return _zip(members(content) | {name: changed}, zipfile.ZIP_DEFLATED)


def _zip(content: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return stream.getvalue()


@cache
def _packed_zeros() -> bytes:
    packer = zlib.compressobj(9)
    return b"".join(packer.compress(bytes(2**20)) for _ in range(1024)) + packer.flush()


def _chunk(kind: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)


def _with_word(value: int) -> Edit:
    def edit(content: bytes, chance: random.Random) -> bytes:
        place = 4 * chance.randrange(max(1, min(len(content), 160) // 4))
        return content[:place] + struct.pack("<I", value) + content[place + 4 :]

    return edit
