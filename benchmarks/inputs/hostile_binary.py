"""Images, arrays, depth and archives that are crafted to harm their reader, from valid ones."""

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
_PNG = b"\x89PNG\r\n\x1a\n"
_PART = 2**20
# The last block of a stream of LZFSE.
_END = b"bvx$"


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

    def sized(width: int, height: int) -> Edit:
        return lambda content, _: _with_chunk(content, 8, struct.pack(">II", width, height), 0)

    return {
        "60000x60000 pixels": sized(60_000, 60_000),
        "2^31 pixels wide": sized(2**31 - 1, 2**31 - 1),
        "0x0 pixels": sized(0, 0),
        "20000x20000 pixels, 400 KB": lambda *_: _black_png(20_000, 20_000),
        "1x1 pixel": lambda *_: _black_png(1, 1),
        "64 bits": lambda content, _: _with_chunk(content, 8, b"\x40", 8),
        "palette without colours": lambda content, _: _with_chunk(content, 8, b"\x08\x03", 8),
        "pixels of 1 GB": lambda content, _: content[:33] + _chunk(b"IDAT", _packed_zeros(1024)),
        "a chunk of 4 GB": lambda content, _: content[:33] + b"\xff\xff\xff\xffIDAT" + content[41:],
    }


def jpeg_edits() -> dict[str, Edit]:
    """Changes of JPEG images."""

    def sized(width: int, height: int) -> Edit:
        def edit(content: bytes, _: random.Random) -> bytes:
            place = content.find(b"\xff\xc0")
            if place < 0:
                return content
            return content[: place + 5] + struct.pack(">HH", height, width) + content[place + 9 :]

        return edit

    app = b"\xff\xe1" + struct.pack(">H", 16) + b"Exif\0\0II*\0\xff\xff\xff\xff"
    return {
        "65500x65500 pixels": sized(65_500, 65_500),
        "0x0 pixels": sized(0, 0),
        "60x60000 pixels": sized(60, 60_000),
        "damaged EXIF": lambda content, _: content[:2] + app + content[2:],
    }


def array_edits() -> dict[str, Edit]:
    """Changes of `.npy` files."""

    def headed(header: str) -> Edit:
        return lambda *_: _npy(header, bytes(64))

    def saved(values: object) -> Edit:
        def edit(*_: object) -> bytes:
            stream = io.BytesIO()
            np.save(stream, np.asarray(values))
            return stream.getvalue()

        return edit

    form = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}"
    shapes = ("(1000000000000,)", "(4294967296, 4294967296)", "(-1,)", "(16.5,)", "(True,)", "16")
    types = ("'O'", "'<U1000000000'", "'V0'", "[('a', '<f4')]", "'<c8'", "'zz'", "'<M8[s]'")
    edits = {f"shape {shape}": headed(form.format("'<f4'", shape)) for shape in shapes}
    edits |= {f"type {dtype}": headed(form.format(dtype, "(16,)")) for dtype in types}
    return edits | {
        "parentheses in the header": headed("(" * 5000),
        "a program as the header": headed("__import__('os').abort()"),
        "a header of 1 MB": headed(form.format("'<f4'", "(16,)") + " " * 2**20),
        "version 9": lambda content, _: content[:6] + b"\x09\0" + content[8:],
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

    return {
        "encrypted": flags(6, 8, b"\x01\0"),
        "method 99": flags(8, 10, b"\x63\0"),
        "method LZMA": flags(8, 10, b"\x0e\0"),
        "a wrong checksum": flags(14, 16, b"\x12\x34\x56\x78"),
        "a member of 4 GB declared": flags(22, 24, b"\xfe\xff\xff\xff"),
        "a name of 64 KB": flags(26, 28, b"\xff\xff"),
        "zeros of 3 GB in a member": lambda content, _: _with_bomb(content),
        "a member twice": lambda content, _: _with_members(content, twice=True),
        "paths above": lambda content, _: _with_members(content, {"../../a": b"b", "/a": b"c"}),
        "100,000 members": lambda content, _: _with_members(
            content, {f"{k}": b"" for k in range(100_000)}
        ),
        "no members": lambda *_: _zip({}),
    }


def depth_edits() -> dict[str, Edit]:
    """Streams of LZFSE: of zeros, and of blocks that announce more than they contain."""

    def always(content: bytes) -> Edit:
        return lambda *_: content

    return {
        "4 GB of zeros": lambda *_: _packed_gigabytes(),
        "a block of 4 GB": always(b"bvx-" + struct.pack("<I", 0xFFFFFFF0) + bytes(64) + _END),
        "LZVN of 4 GB": always(b"bvxn" + struct.pack("<II", 0xFFFFFFF0, 64) + bytes(64) + _END),
        "an unknown block": always(b"bvx9" + bytes(64)),
        "no end": always(b"bvx-" + struct.pack("<I", 4) + b"aaaa"),
        "no values": always(_END),
    }


@cache
def _packed_gigabytes() -> bytes:
    import lzfse

    part = bytes(lzfse.compress(bytes(2**26)))
    return part.removesuffix(_END) * 64 + _END


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


def _with_members(
    content: bytes, added: dict[str, bytes] | None = None, twice: bool = False
) -> bytes:
    stream, found = io.BytesIO(), members(content)
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in [*(found | (added or {})).items(), *(found.items() if twice else ())]:
            archive.writestr(name, data)
    return stream.getvalue()


def _with_bomb(content: bytes) -> bytes:
    """An archive whose first member is three gigabytes of zeros, packed to three megabytes."""
    found = members(content)
    name = next(iter(found), "a").encode()
    size = 3 * 2**30
    packed = _packed_zeros(size // _PART, raw=True)
    head = struct.pack(
        "<HHHHHIIIHH", 20, 0, 8, 0, 33, _crc_of_zeros(), len(packed), size, len(name), 0
    )
    rest = _zip(dict(list(found.items())[1:]))
    # The other members keep their places, so the new one lies between them and the list.
    with zipfile.ZipFile(io.BytesIO(rest)) as archive:
        start, count = archive.start_dir, len(archive.namelist())
    entries = rest[start : rest.rfind(b"PK\x05\x06")]
    entry = b"PK\x01\x02\x14\0" + head + struct.pack("<HHHII", 0, 0, 0, 0, start) + name
    data = rest[:start] + b"PK\x03\x04" + head + name + packed
    numbers = (0, 0, count + 1, count + 1, len(entries) + len(entry), len(data), 0)
    return data + entries + entry + b"PK\x05\x06" + struct.pack("<HHHHIIH", *numbers)


@cache
def _crc_of_zeros() -> int:
    checksum, part = 0, bytes(2**24)
    for _ in range(3 * 2**30 // len(part)):
        checksum = zlib.crc32(part, checksum)
    return checksum


@cache
def _packed_zeros(megabytes: int, raw: bool = False) -> bytes:
    """A stream of zeros: one packed megabyte, repeated."""
    packer = zlib.compressobj(9, wbits=-15)
    part = packer.compress(bytes(_PART)) + packer.flush(zlib.Z_FULL_FLUSH)
    content = part * megabytes + b"\x03\0"
    if raw:
        return content
    # Adler-32 of zeros counts them.
    checksum = (megabytes * _PART % 65521) << 16 | 1
    return b"\x78\xda" + content + struct.pack(">I", checksum)


@cache
def _black_png(width: int, height: int) -> bytes:
    """A grey image of 16 bits; most of its pixels are not stored separately."""
    size = height * (2 * width + 1)
    packed = _packed_zeros(size // _PART + 1) if size > _PART else zlib.compress(bytes(size))
    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return _PNG + _chunk(b"IHDR", head) + _chunk(b"IDAT", packed) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)


def _with_chunk(content: bytes, start: int, values: bytes, offset: int) -> bytes:
    """A PNG with other values in the chunk at a place, and its checksum corrected."""
    length = int.from_bytes(content[start : start + 4], "big")
    body = bytearray(content[start + 8 : start + 8 + length])
    body[offset : offset + len(values)] = values
    whole = _chunk(content[start + 4 : start + 8], bytes(body))
    return content[:start] + whole + content[start + 12 + length :]


def _npy(header: str, content: bytes) -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x02\0" + struct.pack("<I", len(text)) + text + content


def _with_word(value: int) -> Edit:
    def edit(content: bytes, chance: random.Random) -> bytes:
        place = 4 * chance.randrange(max(1, min(len(content), 160) // 4))
        return content[:place] + struct.pack("<I", value) + content[place + 4 :]

    return edit
