"""Incremental writing of a splat PLY, so that the map need not fit in memory."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from numpy.typing import NDArray

from toolkit.base.errors import RunFolderError
from toolkit.io.atomic import WRITING, replacing
from toolkit.io.splat_columns import SplatLike
from toolkit.io.splats import PathLike, write_splat_ply

_END = b"end_header\n"
_ROWS = b"element vertex %d\n"


def write_splat_parts(
    path: PathLike, parts: Iterable[tuple[SplatLike, Mapping[str, NDArray]]]
) -> None:
    """Write the parts of a map as one PLY, byte-identical to `write_splat_ply` of all Gaussians.

    Args:
        path: the file, ending in `.ply`.
        parts: splats and their additional columns; empty parts are skipped.

    Raises:
        ValueError: a column has the wrong length, or the parts have different columns.
        RunFolderError: the file cannot be written, or there is nothing to write.
    """
    headers: set[bytes] = set()
    total = 0
    with (
        replacing(path) as temporary,
        TemporaryDirectory(prefix=WRITING, dir=Path(path).parent) as folder,
    ):
        part, rows = Path(folder) / "part.ply", Path(folder) / "rows"
        with rows.open("wb") as body:
            for splats, columns in parts:
                count = len(splats.means)
                if count:
                    write_splat_ply(part, splats, columns)
                    with part.open("rb") as file:
                        headers.add(_header(file).replace(_ROWS % count, _ROWS % 0))
                        shutil.copyfileobj(file, body)
                    total += count
        if not headers:
            raise RunFolderError(f"cannot write {path}: the map contains no Gaussians")
        if len(headers) > 1:
            raise ValueError("the parts of a map must have the same columns")
        with rows.open("rb") as body, temporary.open("wb") as file:
            file.write(headers.pop().replace(_ROWS % 0, _ROWS % total))
            shutil.copyfileobj(body, file)


def _header(file: BinaryIO) -> bytes:
    """Read the header of a PLY."""
    lines: list[bytes] = []
    while not lines or lines[-1] not in (_END, b""):
        lines.append(file.readline())
    return b"".join(lines)
