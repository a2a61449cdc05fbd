"""Folders that a job writes as a whole; the same job repeats what it left when it was killed.

While a job writes a folder, an empty file marks it, whose name has the job and a hash of its
options. The same command then writes the same files again; all others in the folder are kept.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from toolkit.base.errors import RunFolderError, Stopped
from toolkit.io import storage
from toolkit.runs.lock import locked, unlisted
from toolkit.runs.stopping import StopSignals

_PREFIX = ".unfinished-"


@contextmanager
def repeatable() -> Iterator[None]:
    """Let signals end a job that can be repeated.

    Raises:
        Stopped: a signal ends the job.
    """
    try:
        with StopSignals().handled():
            yield
    except Stopped as stopped:
        raise Stopped(stopped.number, "repeat the command to do it again") from None


@dataclass(frozen=True)
class NewFolder:
    """A folder that a job writes.

    Attributes:
        place: a path or a URL.
        job: name of the job.
        options: what determines the files, with a `repr` that is the same in every process.
        option: the option that names the folder, for messages.
    """

    place: str
    job: str
    options: object
    option: str = "--out"

    @property
    def marker(self) -> str:
        """Name of the file that exists while the folder is written."""
        digest = hashlib.sha256(repr(self.options).encode()).hexdigest()
        return f"{_PREFIX}{self.job}-{digest[:16]}"

    def check(self) -> bool:
        """Check that the folder is new, empty, or left by the same job.

        Returns:
            Whether it was left by the same job.

        Raises:
            RunFolderError: it contains something else.
        """
        names = unlisted(storage.names_in(self.place))
        if self.marker in names:
            return True
        others = [name for name in names if name.startswith(_PREFIX)]
        if others:
            job = others[0].removeprefix(_PREFIX).rpartition("-")[0]
            raise RunFolderError(
                f"{self.place} was left by an interrupted semsplat {job} with other arguments; "
                f"repeat that command, or choose another {self.option}"
            )
        if names or (not storage.is_url(self.place) and Path(self.place).is_file()):
            raise RunFolderError(
                f"{self.place} is not an empty folder; choose another {self.option}"
            )
        return False

    def begin(self) -> bool:
        """Mark the folder, and remove what the killed job was writing or replacing.

        Returns:
            Whether the folder was left by the same job.

        Raises:
            RunFolderError: as `check`, or the folder cannot be written.
        """
        again = self.check()
        if again:
            storage.remove_leftovers(self.place)
        else:
            storage.write_bytes(storage.join(self.place, self.marker), b"")
        return again

    def complete(self) -> None:
        """Remove the mark."""
        storage.remove_file(storage.join(self.place, self.marker))

    @contextmanager
    def written(self) -> Iterator[None]:
        """Write a local folder within a block, as its only writer.

        Raises:
            RunFolderError: as `begin`, or another process writes the folder.
            Stopped: a signal ends the job.
        """
        folder = Path(self.place)
        existed = folder.is_dir()
        try:
            with repeatable(), locked(folder):
                self.begin()
                try:
                    yield
                except BaseException:
                    if unlisted(storage.names_in(self.place)) == [self.marker]:
                        self.complete()  # nothing was written
                    raise
                self.complete()
        finally:
            if not existed and folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
