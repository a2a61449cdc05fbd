"""One process at a time writes a run folder."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from toolkit.base.errors import RunFolderError
from toolkit.io.atomic import TEMPORARY

LOCK = ".lock"

_log = logging.getLogger(__name__)


def is_unused(folder: Path) -> bool:
    """Return whether a folder does not exist, or contains nothing but what a process left there."""
    return not folder.exists() or (
        folder.is_dir() and not unlisted(path.name for path in folder.iterdir())
    )


def unlisted(names: Iterable[str]) -> list[str]:
    """The names in a folder without the lock and temporary files, which killed processes leave."""
    return [name for name in names if name != LOCK and not name.startswith(TEMPORARY)]


@contextmanager
def locked(folder: Path, patience_s: float = 0.0) -> Iterator[None]:
    """Hold a run folder as its only writer; the death of the process releases it.

    A file in the folder is locked, and removed at the end. Folders that cannot be written and file
    systems without locks are not protected.

    Args:
        folder: the run folder; created if it does not exist.
        patience_s: time to wait for the end of another process, seconds.

    Raises:
        RunFolderError: another process holds the folder.
    """
    path = folder / LOCK
    lock = FileLock(path, timeout=patience_s)
    try:
        lock.acquire()
    except Timeout as error:
        raise RunFolderError(
            f"another process is running in {folder}; wait for its end, or choose another output "
            f"folder"
        ) from error
    except OSError as error:
        _log.info("%s is not locked: %s.", folder, error.strerror)
    try:
        yield
    finally:
        if lock.is_locked:
            # Removed while it is held: whoever has opened the file before sees that it is gone.
            path.unlink(missing_ok=True)
            lock.release()
