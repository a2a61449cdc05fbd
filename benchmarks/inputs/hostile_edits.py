"""Documents, images and archives that are crafted to harm their reader, from valid ones.

Tests of `io` have more of each container and format of splats.
"""

from __future__ import annotations

import copy
import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

import yaml

Edit = Callable[[bytes, random.Random], bytes]
Edits = dict[str, Edit]

# What must not be read without an error.
TWICE, TO_THE_BASE_OF_60 = "a key given twice", "to the base of 60"
_NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")
_TEXT = re.compile(r'"[^"\\]*"(?!\s*:)')
_PATH = re.compile(r"\S+\.(png|jpg)")
_NESTED = "[" * 100_000 + "]" * 100_000
_WORDS = {"-1": 0xFFFFFFFF, "2^31-1": 0x7FFFFFFF, "-2^31": 0x80000000, "2^24": 2**24, "0": 0}
# What one value of a document is replaced by.
_VALUES: Mapping[str, Any] = {
    "null": None,
    "an empty list": [],
    "a text": "many",
    "a path": "../../../../dev/zero",
    "a sequence of the terminal": "\x1b]0;owned\x07\x1b[31mred\x1b[0m\x08",
    "a text of 1 MB": "a" * 2**20,
    "a negative number": -1,
    "2^63": 2**63,
    "1e308": 1e308,
    "NaN": float("nan"),
    "infinity": float("inf"),
    "a list of 10,000": [0] * 10**4,
}
_ALIASES = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]\n"
    for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


def json_edits() -> Edits:
    """Changes of JSON by name."""
    return {
        **_with_values(json.loads, json.dumps),
        "a value in 100,000 lists": _replaced(_NUMBER, _NESTED),
        "NUL in a text": _replaced(_TEXT, r'"a\u0000b"'),
        "half of a surrogate pair": _replaced(_TEXT, r'"a\ud800b"'),
        TWICE: _with_first_twice,
        "300,000 keys": lambda *_: json.dumps({str(k): k for k in range(300_000)}).encode(),
    } | text_edits()


def yaml_edits() -> Edits:
    """Changes of YAML by name."""
    return {
        **_with_values(yaml.safe_load, yaml.safe_dump),
        "aliases of aliases": _content(_ALIASES.encode()),
        "an object of Python": _content(b'!!python/object/apply:os.system ["true"]\n'),
        "a date": _replaced(_NUMBER, "2026-99-99"),
        TO_THE_BASE_OF_60: _replaced(_NUMBER, "1:30"),
        "many lines": lambda content, _: content + b"".join(b"k%d: 1\n" % k for k in range(20_000)),
        TWICE: lambda content, _: content + b"\n" + content.splitlines()[0],
    } | text_edits()


def table_edits() -> Edits:
    """Changes of lines of numbers and names."""
    numbers = ("nan", "inf", "-1", "0", "1e308", "1e999", "0x10", "1_000", "٣", "2147483648")
    return {
        **{f"{n} for a number": _replaced(_NUMBER, n, anywhere=True) for n in numbers},
        "100,000 times": lambda content, _: content * (100_000 // max(1, len(content) // 50)),
        "a line given twice": lambda content, _: content + b"\n" + content.splitlines()[-1],
        "a path above": _replaced(_PATH, "../../../dev/zero"),
        "NUL in a path": _replaced(_PATH, "a\0.png"),
    } | text_edits()


def text_edits() -> Edits:
    """Changes of any text by name."""
    return {
        **{
            f"a number of {count} digits": _replaced(_NUMBER, "9" * count, anywhere=True)
            for count in (400, 6000)
        },
        "100,000 lists": _content(_NESTED.encode()),
        "not UTF-8": lambda content, _: content.replace(b"\n", b"\n\xff\xfe\n", 1) or b"\xff",
        "NUL": lambda content, _: content[:5] + b"\0" + content[5:],
        "sequences of the terminal": lambda content, _: b"\x1b]0;a\x07\x1b[2J" + content,
        "a line of 5 MB": lambda content, _: content + b"\n" + b"9" * (5 * 2**20),
    }


def binary_edits() -> Edits:
    """Changes of any content."""
    return {
        **{f"{name} for a word of the head": _with_word(value) for name, value in _WORDS.items()},
        "empty": _content(b""),
        "a byte": _content(b"\0"),
        "1 MB of zeros": _content(bytes(2**20)),
        "noise": lambda _, chance: chance.randbytes(2**16),
        "half of it": lambda content, _: content[: len(content) // 2],
        "all but a byte": lambda content, _: content[:-1],
        "twice": lambda content, _: content * 2,
        "another format": _content(_zip({"a": b"b"})),
    }


def png_edits() -> Edits:
    """Changes of PNG images."""
    return {
        "60000x60000 pixels": _with_png_head(struct.pack(">II", 60_000, 60_000)),
        "2^31 pixels wide": _with_png_head(struct.pack(">II", 2**31 - 1, 2**31 - 1)),
        "0x0 pixels": _with_png_head(struct.pack(">II", 0, 0)),
        "64 bits": _with_png_head(b"\x40", 8),
        "palette without colours": _with_png_head(b"\x08\x03", 8),
        "pixels of 1 GB": lambda content, _: content[:33] + _chunk(b"IDAT", _packed_zeros()),
        "a chunk of 4 GB": lambda content, _: content[:33] + b"\xff\xff\xff\xffIDAT" + content[41:],
    }


def archive_edits() -> Edits:
    """Changes of zip archives as a whole."""
    many = {f"{k}": b"" for k in range(100_000)}
    return {
        "encrypted": _with_archive_head(6, b"\x01\0"),
        "method 99": _with_archive_head(8, b"\x63\0"),
        "a wrong checksum": _with_archive_head(14, b"\x12\x34\x56\x78"),
        "a member of 4 GB declared": _with_archive_head(22, b"\xfe\xff\xff\xff"),
        "a name of 64 KB": _with_archive_head(26, b"\xff\xff"),
        "zeros of 1 GB in a member": lambda content, _: with_member(
            content, next(iter(members(content)), "a"), bytes(2**30)
        ),
        "paths above": lambda content, _: _zip(members(content) | {"../../a": b"", "/a": b""}),
        "100,000 members": lambda content, _: _zip(members(content) | many),
        "no members": _content(_zip({})),
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


def _content(changed: bytes) -> Edit:
    return lambda *_: changed


def _replaced(pattern: re.Pattern[str], text: str, anywhere: bool = False) -> Edit:
    """Replaces a match of a pattern: the first, or a random one."""

    def edit(content: bytes, chance: random.Random) -> bytes:
        whole = content.decode()
        found = list(pattern.finditer(whole))
        if not found:
            return text.encode()
        match = chance.choice(found) if anywhere else found[0]
        return (whole[: match.start()] + text + whole[match.end() :]).encode()

    return edit


def _with_values(load: Callable[[Any], Any], dump: Callable[[Any], str]) -> Edits:
    """Replaces one value of a document by each of several ones."""

    def edit_of(value: Any) -> Edit:
        def edit(content: bytes, chance: random.Random) -> bytes:
            try:
                whole = load(content)
            except ValueError:  # no document, or several lines of them
                return dump(value).encode()
            places = list(_places(whole))
            if not places:
                return dump(value).encode()
            holder, key = chance.choice(places)
            holder[key] = copy.deepcopy(value)
            return dump(whole).encode()

        return edit

    return {f"a value is {name}": edit_of(value) for name, value in _VALUES.items()}


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """The containers of a document with each key or index; few of long lists."""
    if not isinstance(value, dict | list):
        return
    for key in list(value) if isinstance(value, dict) else range(min(len(value), 3)):
        yield value, key
        yield from _places(value[key])


def _with_first_twice(content: bytes, _: random.Random) -> bytes:
    """The first key of an object once more, with another value."""
    whole = content.decode()
    match = re.search(r'\{\s*("[^"]*")\s*:', whole)
    if match is None:
        return b'{"a": 1, "a": 2}'
    place = match.start() + 1
    return (whole[:place] + f"{match.group(1)}: 7, " + whole[place:]).encode()


def _with_word(value: int) -> Edit:
    def edit(content: bytes, chance: random.Random) -> bytes:
        place = 4 * chance.randrange(max(1, min(len(content), 160) // 4))
        return content[:place] + struct.pack("<I", value) + content[place + 4 :]

    return edit


def _with_png_head(values: bytes, offset: int = 0) -> Edit:
    """Other values in the first chunk, and its checksum corrected."""

    def edit(content: bytes, _: random.Random) -> bytes:
        body = bytearray(content[16:29])
        body[offset : offset + len(values)] = values
        return content[:8] + _chunk(b"IHDR", bytes(body)) + content[33:]

    return edit


def _chunk(kind: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)


@cache
def _packed_zeros() -> bytes:
    packer = zlib.compressobj(9)
    return b"".join(packer.compress(bytes(2**20)) for _ in range(1024)) + packer.flush()


def _with_archive_head(place: int, value: bytes) -> Edit:
    """Another value in the head of the first member, and in the list at the end."""

    def edit(content: bytes, _: random.Random) -> bytes:
        changed = bytearray(content)
        for magic, offset in ((b"PK\x03\x04", place), (b"PK\x01\x02", place + 2)):
            start = changed.find(magic) + offset
            changed[start : start + len(value)] = value
        return bytes(changed)

    return edit


def _zip(content: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return stream.getvalue()
