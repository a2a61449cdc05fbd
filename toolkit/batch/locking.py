"""Locks of run folders, so that two processes never write the same run."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from toolkit.errors import RunFolderError

# A process whose parent has ended needs a moment to end itself.
_PATIENCE_S = 20.0
_INTERVAL_S = 0.2


@contextmanager
def locked(folder: Path, patience_s: float = _PATIENCE_S) -> Iterator[None]:
    """Hold the lock of a run folder, a file beside it that the system releases with the process.

    Raises:
        RunFolderError: another process executes the run.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no such locks
        yield
        return
    path = folder.with_name(folder.name + ".lock")
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        deadline = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError as error:
                if time.monotonic() > deadline:
                    raise RunFolderError(
                        f"another process executes the run in {folder}; wait for it, or end it"
                    ) from error
                time.sleep(_INTERVAL_S)
        yield
    finally:
        os.close(handle)
