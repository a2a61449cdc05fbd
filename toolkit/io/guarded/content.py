"""The bytes of files, and what is wrong with them."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from toolkit.base.printable import printable

PathLike = str | os.PathLike[str]

# Larger files of which less than half was written are copies or downloads that were not finished.
_MAX_HOLES = 2**30

# As many as maps of hundreds of millions of splats have.
MAX_BYTES = 2**36
_MAX_REASON = 200


class DamagedError(ValueError):
    """The content of a file is damaged, or more than a reader accepts.

    Args:
        reason: one line; long ones, which quote the file, are shortened.
    """

    def __init__(self, reason: object) -> None:
        text = printable(" ".join(str(reason).split()) or repr(reason))
        super().__init__(text if len(text) <= _MAX_REASON else f"{text[:_MAX_REASON]}...")


def check_regular(path: PathLike, max_bytes: int = MAX_BYTES) -> None:
    """Check that a path is a file that ends: devices and pipes may not.

    Raises:
        OSError: it cannot be read.
        DamagedError: it is no file, or larger than the limit.
    """
    try:
        status = os.stat(path)
    except ValueError as error:  # names in files can contain NUL
        raise DamagedError(f"{os.fspath(path)!r} is not the name of a file") from error
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(21, os.strerror(21), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise DamagedError("it is a device or a pipe, not a file")
    if status.st_size > max_bytes:
        raise DamagedError(f"it has {size_text(status.st_size)}, more than {size_text(max_bytes)}")
    if status.st_size > _MAX_HOLES and _written_bytes(path, status.st_size) < status.st_size // 2:
        raise DamagedError(f"most of its {size_text(status.st_size)} were never written")


def _written_bytes(path: PathLike, size: int) -> int:
    """Bytes of a file that are not in holes, up to half of its size."""
    written = end = 0
    with open(path, "rb", buffering=0) as file:
        while end < size and written < size // 2:
            try:
                start = os.lseek(file.fileno(), end, os.SEEK_DATA)
            except OSError:  # nothing follows, or the file system does not say
                break
            end = os.lseek(file.fileno(), start, os.SEEK_HOLE)
            written += end - start
    return written


def read_content(path: PathLike, max_bytes: int = MAX_BYTES) -> bytes:
    """The bytes of a file.

    Raises:
        OSError: it cannot be read.
        DamagedError: it is no file, or larger than the limit.
    """
    check_regular(path, max_bytes)
    return Path(path).read_bytes()


def size_text(count: int) -> str:
    """A number of bytes, as people read it."""
    for unit, name in ((2**30, "GB"), (2**20, "MB"), (2**10, "KB")):
        if count >= unit:
            return f"{count / unit:.3g} {name}"
    return f"{count} bytes"


@contextmanager
def damage() -> Iterator[None]:
    """Turn what a decoder raises in this context into `DamagedError`.

    Raises:
        OSError: of the system.
    """
    try:
        yield
    except (DamagedError, MemoryError):
        raise
    except OSError as error:
        if error.errno is not None:
            raise
        raise DamagedError(error) from error
    except RecursionError as error:
        raise DamagedError("it nests too deeply") from error
    except Exception as error:
        raise DamagedError(error) from error
