"""Files and array trees in local folders and in shared storage (s3://, gs://, ...) by fsspec."""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from toolkit.base.errors import DependencyError, RunFolderError
from toolkit.io.arrays import ArrayTree, read_array_tree, write_array_tree
from toolkit.io.atomic import cannot_write, remove_temporary, replacing
from toolkit.io.atomic import write_bytes as write_local
from toolkit.io.guarded.content import read_content


def is_url(place: str) -> bool:
    """Whether a place is a URL such as s3://bucket/folder instead of a local path."""
    return "://" in place


def join(place: str, *names: str) -> str:
    """Return the place of a file or folder in another one."""
    return "/".join((place.rstrip("/"), *names))


def names_in(place: str) -> list[str]:
    """Return the sorted names of the files and folders in a folder; empty if there is none."""
    if not is_url(place):
        folder = Path(place)
        return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    system, path = _system(place)
    system.invalidate_cache()
    try:
        found = system.ls(path, detail=False)
    except FileNotFoundError:
        return []
    except Exception as error:  # every file system has its own errors
        raise _cannot_read(place, error) from error
    return sorted(name.rstrip("/").rpartition("/")[2] for name in found)


def read_bytes(place: str) -> bytes:
    """Read a file.

    Raises:
        RunFolderError: it does not exist or cannot be read.
    """
    try:
        if not is_url(place):
            return read_content(place)
        system, path = _system(place)
        return bytes(system.cat_file(path))
    except DependencyError:
        raise
    except Exception as error:
        raise _cannot_read(place, error) from error


def write_bytes(place: str, content: bytes) -> None:
    """Write a file; a local one atomically, with the folders above it.

    Raises:
        RunFolderError: it cannot be written.
    """
    if is_url(place):
        _send(place, lambda system, path: system.pipe_file(path, content))
    else:
        _make_parent(Path(place))
        write_local(place, content)


def upload(local: Path, place: str) -> None:
    """Copy a local file, which may be large, to a place.

    Raises:
        RunFolderError: it cannot be written.
    """
    if is_url(place):
        _send(place, lambda system, path: system.put_file(str(local), path))
    else:
        _make_parent(Path(place))
        # It may be on another file system, as temporary folders often are.
        with replacing(place) as temporary:
            shutil.copyfile(local, temporary)


def read_tree(place: str) -> ArrayTree:
    """Read a folder written by `write_tree` or `write_array_tree`.

    Raises:
        RunFolderError: it is missing or cannot be read.
        FormatError: a file is damaged.
    """
    if not is_url(place):
        return read_array_tree(place)
    with TemporaryDirectory() as folder:
        # The metadata are written last; without them the tree is not complete.
        for name in ("metadata.json", "arrays.npz"):
            Path(folder, name).write_bytes(read_bytes(join(place, name)))
        return read_array_tree(folder)


def write_tree(place: str, arrays: dict[str, Any], metadata: dict[str, Any]) -> None:
    """Write arrays and JSON values as one folder.

    Raises:
        RunFolderError: it cannot be written.
    """
    if not is_url(place):
        _make_parent(Path(place))
        write_array_tree(place, arrays, metadata)
        return
    with TemporaryDirectory() as folder:
        local = Path(folder) / "tree"
        write_array_tree(local, arrays, metadata)
        for name in ("arrays.npz", "metadata.json"):
            upload(local / name, join(place, name))


def remove_file(place: str) -> None:
    """Remove a file, if it exists."""
    if not is_url(place):
        Path(place).unlink(missing_ok=True)
        return
    system, path = _system(place)
    if system.exists(path):
        system.rm_file(path)


def remove_leftovers(place: str) -> None:
    """Remove what a killed process was writing or replacing anywhere in a local folder."""
    if is_url(place):
        return  # an upload that did not end left nothing
    remove_temporary(Path(place))


def remove_folder(place: str) -> None:
    """Remove a folder with its content, if it exists."""
    if not is_url(place):
        shutil.rmtree(place, ignore_errors=True)
        return
    system, path = _system(place)
    if names_in(place):
        system.rm(path, recursive=True)


def _system(place: str) -> tuple[Any, str]:
    """Return the file system of a URL and the path in it."""
    protocol, _, path = place.partition("://")
    try:
        fsspec: Any = importlib.import_module("fsspec")
        return fsspec.filesystem(protocol), path
    except ModuleNotFoundError as error:
        raise DependencyError(
            f"{place} needs fsspec; install it: pip install 'semsplat[cluster]'"
        ) from error
    except ImportError as error:
        # The message names the package, for instance s3fs.
        raise DependencyError(f"{place}: {' '.join(str(error).split())}") from error
    except ValueError as error:
        raise RunFolderError(f"{place}: {error}; use a path, s3:// or gs://") from error


def _send(place: str, write: Callable[[Any, str], object]) -> None:
    """Call `write` with the file system of a URL and the path in it."""
    system, path = _system(place)
    try:
        write(system, path)
    except Exception as error:  # every file system has its own errors
        raise _cannot_write(place, error) from error


def _make_parent(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(path.parent, error) from error


def _cannot_read(place: str, error: Exception) -> RunFolderError:
    reason = "it does not exist" if isinstance(error, FileNotFoundError) else _text(error)
    return RunFolderError(f"cannot read {place}: {reason}; check path, access and credentials")


def _cannot_write(place: str, error: Exception) -> RunFolderError:
    return RunFolderError(f"cannot write {place}: {_text(error)}; check access and credentials")


def _text(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
