"""The elements of PLY files: arrays of rows with the names and types of their properties.

RPly, the reader inside Open3D, replaces by zeros what a file lacks, allocates what its header
announces, and prints its messages.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.io.guarded.content import read_content

_END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)
# The byte order of each format; none of text.
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}
_TYPES = {
    name: kind
    for kind, names in {
        "i1": "char int8",
        "u1": "uchar uint8",
        "i2": "short int16",
        "u2": "ushort uint16",
        "i4": "int int32",
        "u4": "uint uint32",
        "f4": "float float32",
        "f8": "double float64",
    }.items()
    for name in names.split()
}
# Longer numbers of rows are none.
_MAX_DIGITS = 18


@dataclass
class _Layout:
    """An element of a header: its number of rows, and the names and types of its properties."""

    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def read_elements(path: Path) -> dict[str, NDArray]:
    """Return the rows [N] of each element by its name, as structured arrays.

    Elements with lists, such as the triangles of a mesh, and those behind them are left out.

    Raises:
        FormatError: it is not a PLY, is truncated, or its header is damaged.
    """
    content = read_content(path)
    if not content.startswith(b"ply"):
        raise FormatError(f"{path} is not a PLY file; write it again")
    end = _END.search(content)
    if end is None:
        raise FormatError(f"{path} is truncated: its header has no end; write it again")
    try:
        order, layouts = _header(content[: end.start()].decode("utf-8", "replace").split("\n")[1:])
        data: memoryview | list[bytes] = memoryview(content)[end.end() :]  # no copies: it is large
        if order is None:
            data = content[end.end() :].split()
        elements, place = {}, 0
        for layout in takewhile(lambda layout: not layout.has_list, layouts):
            dtype = np.dtype([(name, (order or "<") + kind) for name, kind in layout.fields])
            size = dtype.itemsize if order else len(layout.fields)
            if len(data) < place + layout.count * size:
                raise FormatError(
                    f"{path} is truncated: it announces {layout.count} rows of {layout.name!r}, "
                    "which it does not contain; write it again"
                )
            rows = data[place : place + layout.count * size]
            elements[layout.name] = _rows(rows, dtype, layout.count)
            place += layout.count * size
    except ValueError as error:
        raise FormatError(f"{path}: the PLY is damaged ({error}); write it again") from error
    return elements


def _rows(data: memoryview | list[bytes], dtype: np.dtype, count: int) -> NDArray:
    """Rows [N] from bytes, or from the words of a text."""
    if isinstance(data, memoryview):
        return np.frombuffer(data, dtype, count)
    rows, names = np.empty(count, dtype), dtype.names or ()
    for column, name in enumerate(names):
        rows[name] = [float(word) for word in data[column :: len(names)]]
    return rows


def _header(lines: list[str]) -> tuple[str | None, list[_Layout]]:
    """The byte order, which is None for text, and the elements of a header."""
    form, layouts = "", list[_Layout]()
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, _] if name in _ORDERS:
                form = name
            case ["element", name, count] if count.isdecimal() and len(count) <= _MAX_DIGITS:
                layouts.append(_Layout(name, int(count)))
            case ["property", "list", _, _, _] if layouts:
                layouts[-1].has_list = True
            case ["property", kind, name] if layouts and kind in _TYPES:
                layouts[-1].fields.append((name, _TYPES[kind]))
            case _:
                raise ValueError(f"its header has the line {line!r}")
    if not form:
        raise ValueError("its header has no format")
    return _ORDERS[form], layouts
