"""Attacks on single formats: PLY, USD, classes, and compressed depth."""

from __future__ import annotations

import random
import re
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path

from benchmarks.hostile_documents import Edit, text_edits

# The last block of a stream of LZFSE.
_END = b"bvx$"


def ply_edits() -> dict[str, Edit]:
    """Changes of the header of a PLY."""

    def headed(pattern: str, text: str) -> Edit:
        return lambda content, _: re.sub(pattern.encode(), text.encode(), content, count=1)

    counts = ("1000000000000", "4294967295", "-1", "1e9", "9" * 400, "9" * 6000, "0")
    edits = {
        f"{n[:20]} vertices": headed(r"element vertex \d+", f"element vertex {n}") for n in counts
    }
    return edits | {
        "text": headed(r"binary_little_endian", "ascii"),
        "big-endian": headed(r"binary_little_endian", "binary_big_endian"),
        "a list": headed(r"property float x", "property list uint float x"),
        "an unknown type": headed(r"property float x", "property float128 x"),
        "a property twice": headed(r"property float y", "property float x"),
        "100,000 properties": lambda content, _: content.replace(
            b"property float x", b"".join(b"property uchar a%d\n" % k for k in range(100_000))
        ),
        "100,000 elements": lambda content, _: content.replace(
            b"end_header", b"element a 0\n" * 100_000 + b"end_header"
        ),
        "a line of 10 MB": headed("comment", "comment " + "a" * 10**7),
        "no end of the header": headed("end_header", "comment"),
        "a sequence of the terminal": headed("property float x", "property \x1b[31m\x07 x"),
    }


def usd_edits() -> dict[str, Edit]:
    """Changes of a USD file in text."""
    array = "float[] a = [" + "1," * 10**6 + "1]"

    def added(text: str) -> Edit:
        return lambda content, _: content + text.encode()

    nested = "".join(f'def "a{k}" {{\n' for k in range(20_000)) + "}" * 20_000
    return {
        "10^8 prims by references": added(_many_prims(8)),
        "10^30 prims by references": added(_many_prims(30)),
        "a reference to a device": added('def "a" (references = @/dev/zero@</b>) {}\n'),
        "a reference above": added('def "a" (references = @../../../etc/hosts.usda@</b>) {}\n'),
        "a reference to itself": added('def "a" (references = </a>) {}\n'),
        "an asset outside": added('def "a" { asset b = @/etc/passwd@ }\n'),
        "a sublayer outside": lambda content, _: content.replace(
            b"(", b"(\n    subLayers = [@/etc/passwd.usda@]\n", 1
        ),
        "20,000 prims in each other": added(nested),
        "a million numbers": added(f'def "a" {{ {array} }}\n'),
        "an unfinished text": added('def "a" { string b = "'),
        **text_edits(),
    }


def _many_prims(levels: int) -> str:
    """Prims that each refer ten times to the next one."""
    parts = []
    for level in range(levels):
        inside = "".join(f'  def "r{k}" (references = </n{level + 1}>) {{}}\n' for k in range(10))
        parts.append(f'def "n{level}" {{\n{inside}}}\n')
    return "\n" + "".join(parts) + f'def "n{levels}" {{}}\n'


def many_class_names(count: int, name: str) -> Callable[[Path], None]:
    """Writes that many names of classes that no vocabulary has, one a line."""

    def change(folder: Path) -> None:
        chance, letters = random.Random(0), "abcdefghijklmnopqrstuvwxyz"
        names = {"".join(chance.choices(letters, k=chance.randint(8, 16))) for _ in range(count)}
        (folder / name).write_text("\n".join(sorted(names)))

    return change


def large_package(folder: Path) -> None:
    """A package that says it contains gigabytes, in a file of that size without content."""
    path = folder / "map.usdz"
    content = path.read_bytes()
    place = content.rfind(b"PK\x05\x06")
    with path.open("r+b") as file:
        file.truncate(20 * 2**30)
        file.seek(20 * 2**30)
        file.write(content[place:])


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
