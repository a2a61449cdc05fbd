"""One process at a time writes a run folder."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from toolkit.errors import RunFolderError

_log = logging.getLogger(__name__)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a run folder as its only writer; the death of the process releases it.

    The folder itself is locked (`flock`), which leaves no file behind. File systems and operating
    systems without such locks are not protected.

    Raises:
        RunFolderError: another process holds the folder.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                raise RunFolderError(
                    f"another process is running in {path}; wait for its end, or choose another "
                    f"output folder"
                ) from error
            _log.info("The file system of %s has no locks: %s", path, error.strerror)
        yield
    finally:
        os.close(handle)
