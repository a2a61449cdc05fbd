"""`loops.jsonl`: one line of JSON for each loop candidate and what became of it."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from toolkit.errors import FormatError, RunFolderError
from toolkit.io.atomic import cannot_write

_log = logging.getLogger(__name__)


class LoopLog:
    """Appends to the file; what was written is with the system when `write` returns.

    Args:
        path: the file, made where there is none.
        keep_bytes: cut the file back to so many bytes first, as it was at a checkpoint; None
            keeps it all.

    Raises:
        RunFolderError: it cannot be written, or is shorter than what is to be kept.
    """

    def __init__(self, path: str | os.PathLike[str], keep_bytes: int | None = None) -> None:
        self._path = Path(path)
        try:
            with self._path.open("ab") as stream:
                self._size = stream.tell()
        except OSError as error:
            raise cannot_write(self._path, error) from error
        if keep_bytes is not None:
            self.cut_back(keep_bytes)

    @property
    def size_bytes(self) -> int:
        """Length of the file, for a checkpoint."""
        return self._size

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one line, the same bytes for the same record.

        Raises:
            ValueError: a value is not JSON; NaN and infinity are not.
            RunFolderError: the file cannot be written.
        """
        line = (json.dumps(dict(record), allow_nan=False) + "\n").encode()
        try:
            with self._path.open("ab") as stream:
                stream.write(line)
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self._size += len(line)

    def cut_back(self, keep_bytes: int) -> None:
        """Cut the file back to so many bytes, as it was at a checkpoint.

        Raises:
            RunFolderError: it cannot be written, or is shorter.
        """
        if keep_bytes > self._size:
            raise RunFolderError(
                f"{self._path} has {self._size} bytes, its checkpoint says {keep_bytes}; put the "
                "whole file back, or start anew"
            )
        try:
            with self._path.open("ab") as stream:
                stream.truncate(keep_bytes)
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self._size = keep_bytes


def read_loop_log(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The records of the file, oldest first; a last line that was cut off is left out.

    Raises:
        FormatError: the file is missing or a line is no JSON object.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror or error}") from error
    *lines, rest = content.split(b"\n")
    if rest:
        _log.warning("%s: the last line is not whole and is left out", path)
    return [_record(line, f"{path}:{number}") for number, line in enumerate(lines, start=1)]


def _record(line: bytes, place: str) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except ValueError as error:
        raise FormatError(f"{place} is not JSON ({error}); remove the line") from error
    if not isinstance(record, dict):
        raise FormatError(f"{place} holds no record; remove the line")
    return record
