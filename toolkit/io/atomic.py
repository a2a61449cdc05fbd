"""Atomic writing of files: complete or absent, even after `kill -9`."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from toolkit.base.errors import RunFolderError, ToolkitError

# Beginning of the names of what is being written or replaced.
WRITING, REPLACED = ".writing-", ".replaced-"
TEMPORARY = (WRITING, REPLACED)
# Bytes by which a file must be able to grow: more than the blocks of a file system.
_PROBE = 1 << 16


def remove_temporary(folder: Path) -> None:
    """Remove what a killed process was writing or replacing anywhere in a folder."""
    for path in [path for path in folder.rglob(".*") if path.name.startswith(TEMPORARY)]:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


@contextmanager
def replacing(path: str | os.PathLike[str], size: int = 0) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` when the block ends without an exception.

    The temporary file is in the same folder and has the suffix of `path`, because some writers
    choose the format by the suffix.

    Args:
        path: the file.
        size: number of bytes that must be free before the block starts, for libraries that crash
            on a full disk.

    Raises:
        RunFolderError: the file cannot be written (disk full, no permission, no folder).
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(prefix=WRITING, suffix=path.suffix, dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise cannot_write(path, error) from error
    temporary = Path(name)
    try:
        _check_room(temporary, size)
        yield temporary
        _check_room(temporary)
        # mkstemp creates private files; results get the default permissions.
        temporary.chmod(0o666 & ~umask())
        sync(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise cannot_write(path, error) from error
    except ToolkitError:
        raise
    except Exception as error:
        # Libraries have errors of their own for a full disk.
        try:
            _check_room(temporary)
        except OSError as full:
            raise cannot_write(path, full) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file atomically.

    Raises:
        RunFolderError: the file cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file in UTF-8 atomically, see `utf8`.

    Raises:
        RunFolderError: the file cannot be written.
    """
    write_bytes(path, utf8(text))


def utf8(text: str) -> bytes:
    """Encode a text that may contain names of files.

    Where the locale cannot decode a name, Python keeps its bytes as surrogates. They are written as
    they are if they are UTF-8, and as escapes otherwise.
    """
    return text.encode(errors="surrogateescape").decode(errors="backslashreplace").encode()


def _check_room(path: Path, more: int = 0) -> None:
    """Check that a file can grow, because some libraries truncate files silently on a full disk.

    Args:
        path: the file.
        more: number of bytes beside those that every file must be able to grow by.
    """
    with path.open("r+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        try:
            if more and hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), size, more)
                file.seek(0, os.SEEK_END)
            missing = _PROBE
            while missing > 0:
                missing -= file.write(bytes(missing)) or 0
        finally:
            file.truncate(size)


def sync(path: Path) -> None:
    """Flush a file or a folder's directory entries to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def cannot_write(path: Path, error: OSError) -> RunFolderError:
    """Return the one-line error for a file or folder that could not be written."""
    return RunFolderError(
        f"cannot write {path}: {error.strerror or error}; free space there, "
        f"allow writing, or choose another folder"
    )


def umask() -> int:
    """The permissions that the user's new files lack."""
    # Python can only read the mask by setting it.
    mask = os.umask(0)
    os.umask(mask)
    return mask
