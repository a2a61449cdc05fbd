"""Files as people's systems leave them: marks of byte order, and hidden files beside their own."""

from __future__ import annotations

import codecs
import os
from pathlib import Path

from toolkit.io.guarded.content import read_content

# A million poses with their covariances.
_MAX_TEXT = 2**28
# Folders and files that macOS and Windows add. Names that start with a dot are hidden everywhere;
# macOS writes ._NAME beside each NAME on the disks and into the archives of other systems.
_ADDED = ("__MACOSX", "Thumbs.db", "ehthumbs.db", "desktop.ini")


def read_text(path: str | os.PathLike[str], max_bytes: int = _MAX_TEXT) -> str:
    """Read a text file in UTF-8, with or without a byte order mark, or in UTF-16 with one.

    Raises:
        OSError: the file cannot be read.
        UnicodeDecodeError: it is not such a text.
        DamagedError: it is no file, or larger than the limit.
    """
    content = read_content(path, max_bytes)
    marked = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if marked else "utf-8-sig")


def visible(folder: Path) -> list[Path]:
    """The entries of a folder by name, without hidden ones and those that systems add."""
    return sorted(
        path
        for path in folder.iterdir()
        if not path.name.startswith(".") and path.name not in _ADDED
    )
