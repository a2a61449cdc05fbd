"""Atomic storage of named arrays with JSON metadata in one folder.

Arrays are stored in an `.npz` file and everything else in JSON; pickle is not used.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.io.atomic import REPLACED, WRITING, cannot_write, replacing, sync, umask
from toolkit.io.guarded.arrays import read_arrays
from toolkit.io.guarded.documents import read_json

PathLike = str | os.PathLike[str]

_ARRAYS, _METADATA = "arrays.npz", "metadata.json"


@dataclass(frozen=True)
class ArrayTree:
    """Content of a folder.

    Attributes:
        arrays: arrays by name; slashes in names have no special meaning.
        metadata: JSON values.
    """

    arrays: dict[str, NDArray]
    metadata: dict[str, Any]


def arrays_below(arrays: Mapping[str, NDArray], prefix: str) -> dict[str, NDArray]:
    """Return the arrays whose names start with a prefix, keyed without the prefix."""
    return {k[len(prefix) :]: a for k, a in arrays.items() if k.startswith(prefix)}


def write_array_tree(
    folder: PathLike, arrays: Mapping[str, NDArray], metadata: Mapping[str, Any]
) -> None:
    """Write arrays and metadata as one folder; the output is byte-for-byte reproducible.

    The content is written to a temporary sibling of `folder`, synced, and renamed. An existing
    `folder` is moved away just before the rename, so for a moment neither exists. Callers that
    must survive a kill at any time write to a new name and keep the old folder until this
    function returns.

    Args:
        folder: the folder to create or replace; its parent must exist.
        arrays: numeric or boolean arrays by name.
        metadata: JSON values, without NaN and infinity.

    Raises:
        ValueError: an array contains objects, or the metadata is not valid JSON.
        RunFolderError: the folder cannot be written.
    """
    folder = Path(folder)
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise ValueError(f"array {name!r} contains Python objects; only numbers can be stored")
    text = json.dumps(dict(metadata), indent=1, sort_keys=True, allow_nan=False)
    temporary: Path | None = None
    try:
        temporary = Path(tempfile.mkdtemp(prefix=WRITING, dir=folder.parent))
        _write_arrays(temporary / _ARRAYS, arrays)
        (temporary / _METADATA).write_text(text + "\n", encoding="utf-8")
        sync(temporary / _METADATA)
        sync(temporary)
        temporary.chmod(0o777 & ~umask())
        _put_in_place(temporary, folder)
    except OSError as error:
        raise cannot_write(folder, error) from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def compress_array_tree(folder: PathLike) -> None:
    """Compress the arrays of a folder in place; it is read as before.

    Raises:
        RunFolderError: the folder cannot be read, or the disk is full; nothing has changed.
        FormatError: the folder is damaged.
    """
    path = Path(folder) / _ARRAYS
    try:
        with (
            replacing(path) as temporary,
            zipfile.ZipFile(path) as stored,
            zipfile.ZipFile(temporary, "w") as archive,
        ):
            for member in stored.infolist():
                copied = zipfile.ZipInfo(member.filename, member.date_time)
                archive.writestr(copied, stored.read(member), zipfile.ZIP_DEFLATED, 1)
    except zipfile.BadZipFile as error:
        raise FormatError(f"{path} is damaged ({error}); run again") from error


def read_array_tree(folder: PathLike, wanted: Callable[[str], bool] | None = None) -> ArrayTree:
    """Read a folder written by `write_array_tree` and verify its checksums.

    Args:
        folder: the folder.
        wanted: whether to read the array of a name; all are read by default.

    Raises:
        RunFolderError: the folder or one of its files is missing.
        FormatError: a file is damaged.
    """
    folder = Path(folder)
    try:
        metadata = read_json(folder / _METADATA)
        arrays = read_arrays(folder / _ARRAYS, wanted)
    except OSError as error:
        raise RunFolderError(
            f"cannot read {folder}: {error.strerror or error}; use an older checkpoint, "
            f"or start again"
        ) from error
    except ValueError as error:
        raise FormatError(
            f"{folder} is damaged ({error}); use an older checkpoint, or start again"
        ) from error
    if not isinstance(metadata, dict):
        raise FormatError(f"{folder} is damaged: {_METADATA} is not a JSON object")
    return ArrayTree(arrays, metadata)


def _write_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write an npz file with sorted names and a fixed date, so that it is reproducible."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            member = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(arrays[name]), allow_pickle=False)
    sync(path)


def _put_in_place(temporary: Path, folder: Path) -> None:
    old: Path | None = None
    if folder.exists():
        old = Path(tempfile.mkdtemp(prefix=REPLACED, dir=folder.parent))
        os.replace(folder, old / folder.name)
    os.replace(temporary, folder)
    sync(folder.parent)
    if old is not None:
        shutil.rmtree(old, ignore_errors=True)
