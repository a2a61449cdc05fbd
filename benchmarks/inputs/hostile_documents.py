"""Documents, tables and scenes in text that are crafted to harm their reader, from valid ones."""

from __future__ import annotations

import copy
import json
import random
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import yaml

Edit = Callable[[bytes, random.Random], bytes]

_NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")
_TEXT = re.compile(r'"[^"\\]*"(?!\s*:)')
_NESTING = 100_000
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
    "a list of a million": [0] * 10**6,
}


def json_edits() -> dict[str, Edit]:
    """Changes of JSON by name."""
    edits: dict[str, Edit] = {
        f"a value is {name}": _with_value(value, json.loads, json.dumps)
        for name, value in _VALUES.items()
    }
    edits |= {
        "100,000 lists": lambda *_: b"[" * _NESTING + b"]" * _NESTING,
        "a value in 100,000 lists": _replaced(_NUMBER, "[" * _NESTING + "]" * _NESTING),
        "NUL in a text": _replaced(_TEXT, r'"a\u0000b"'),
        "half of a surrogate pair": _replaced(_TEXT, r'"a\ud800b"'),
        "a key given twice": _with_first_twice,
        "a number only": lambda *_: b"3",
        "300,000 keys": lambda *_: json.dumps({str(k): k for k in range(300_000)}).encode(),
    }
    return edits | _digits() | text_edits()


def yaml_edits() -> dict[str, Edit]:
    """Changes of YAML by name."""
    aliases = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]\n"
        for old, new in zip("abcdefgh", "bcdefghi", strict=True)
    )
    edits: dict[str, Edit] = {
        f"a value is {name}": _with_value(value, yaml.safe_load, yaml.safe_dump)
        for name, value in _VALUES.items()
        if name != "a list of a million"
    }
    edits |= {
        "100,000 lists": lambda *_: b"[" * _NESTING + b"]" * _NESTING,
        "aliases of aliases": lambda *_: aliases.encode(),
        "an object of Python": lambda *_: b'!!python/object/apply:os.system ["true"]\n',
        "a date": _replaced(_NUMBER, "2026-99-99"),
        "to the base of 60": _replaced(_NUMBER, "1:30"),
        "many lines": lambda content, _: content + b"".join(b"k%d: 1\n" % k for k in range(20_000)),
        "a key given twice": lambda content, _: content + b"\n" + content.splitlines()[0],
    }
    return edits | _digits() | text_edits()


def text_edits() -> dict[str, Edit]:
    """Changes of any text by name."""
    return {
        "not UTF-8": lambda content, _: content.replace(b"\n", b"\n\xff\xfe\n", 1) or b"\xff",
        "NUL": lambda content, _: content[:5] + b"\0" + content[5:],
        "sequences of the terminal": lambda content, _: b"\x1b]0;a\x07\x1b[2J" + content,
        "a line of 5 MB": lambda content, _: content + b"\n" + b"9" * (5 * 2**20),
    }


def table_edits() -> dict[str, Edit]:
    """Changes of lines of numbers and names."""
    numbers = ("nan", "inf", "-1", "0", "1e308", "1e999", "0x10", "1_000", "٣", "2147483648")
    edits = {f"{n} for a number": _replaced(_NUMBER, n, anywhere=True) for n in numbers}
    edits |= {
        "100,000 times": lambda content, _: content * (100_000 // max(1, len(content) // 50)),
        "a line given twice": _with_last_line_twice,
        "a path above": _replaced(re.compile(r"\S+\.(png|jpg)"), "../../../dev/zero"),
        "NUL in a path": _replaced(re.compile(r"\S+\.(png|jpg)"), "a\0.png"),
    }
    return edits | _digits() | text_edits()


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
        "10^30 prims by references": added(_many_prims(30)),
        "a reference to a device": added('def "a" (references = @/dev/zero@</b>) {}\n'),
        "a reference above": added('def "a" (references = @../../../etc/hosts.usda@</b>) {}\n'),
        "a reference to itself": added('def "a" (references = </a>) {}\n'),
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


def _digits() -> dict[str, Edit]:
    return {
        f"a number of {count} digits": _replaced(_NUMBER, "9" * count, anywhere=True)
        for count in (400, 6000)
    }


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


def _with_value(value: Any, load: Callable[[Any], Any], dump: Callable[[Any], str]) -> Edit:
    """Replaces one value of a document."""

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


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """The containers of a document with each key or index; few of long lists."""
    if isinstance(value, dict):
        keys: list[Any] = list(value)
    elif isinstance(value, list):
        keys = list(range(min(len(value), 3)))
    else:
        return
    for key in keys:
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


def _with_last_line_twice(content: bytes, _: random.Random) -> bytes:
    lines = [line for line in content.splitlines() if line.strip()]
    return content.rstrip(b"\n") + b"\n" + (lines[-1] if lines else b"") + b"\n"
