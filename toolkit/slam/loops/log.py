"""`loops.jsonl`: one JSON line per loop candidate, search and verification result."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.io.atomic import cannot_write
from toolkit.io.guarded.content import DamagedError, read_content
from toolkit.io.guarded.documents import parse_json

# Of hundreds of thousands of loop candidates.
_MAX_BYTES = 2**30

_log = logging.getLogger(__name__)


class LoopLog:
    """Appends records to the file; each `write` flushes to the operating system.

    Args:
        path: log file, created if missing.
        convert: applied to every record; by default none is changed.

    Raises:
        RunFolderError: the file cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        convert: Callable[[Mapping[str, Any]], dict[str, Any]] = dict,
    ) -> None:
        self._path, self._convert = Path(path), convert
        try:
            with self._path.open("ab") as stream:
                self._size = stream.tell()
        except OSError as error:
            raise cannot_write(self._path, error) from error

    @property
    def size_bytes(self) -> int:
        """Size of the file, stored in checkpoints."""
        return self._size

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one record as a line of JSON.

        Raises:
            ValueError: a value is not valid JSON, for instance NaN or infinity.
            RunFolderError: the file cannot be written.
        """
        line = (json.dumps(self._convert(record), allow_nan=False) + "\n").encode()
        try:
            with self._path.open("ab") as stream:
                stream.write(line)
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self._size += len(line)

    def truncate(self, keep_bytes: int) -> None:
        """Truncate the file to its size at a checkpoint.

        Raises:
            RunFolderError: the file cannot be written or is shorter than `keep_bytes`.
        """
        if keep_bytes > self._size:
            raise RunFolderError(
                f"{self._path} has {self._size} bytes, but the checkpoint expects {keep_bytes}; "
                "restore the complete file or start a new run"
            )
        try:
            with self._path.open("ab") as stream:
                stream.truncate(keep_bytes)
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self._size = keep_bytes


def read_loop_log(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Read the records of the file, oldest first; an incomplete last line is skipped.

    Raises:
        FormatError: the file is missing or a line is not a JSON object.
    """
    try:
        content = read_content(path, _MAX_BYTES)
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror or error}") from error
    except DamagedError as error:
        raise FormatError(f"cannot read {path}: {error}; restore it, or run again") from error
    *lines, rest = content.split(b"\n")
    if rest:
        _log.warning("%s: skipped the incomplete last line", path)
    return [_record(line, f"{path}:{number}") for number, line in enumerate(lines, start=1)]


def _record(line: bytes, location: str) -> dict[str, Any]:
    try:
        record = parse_json(line)
    except ValueError as error:
        raise FormatError(f"{location} is not JSON ({error}); remove the line") from error
    if not isinstance(record, dict):
        raise FormatError(f"{location} is not a JSON object; remove the line")
    return record
