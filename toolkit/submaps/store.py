"""Where submaps rest: in memory as far as a budget goes, on disk beyond it."""

from __future__ import annotations

import logging
import re
import shutil
from pathlib import Path

from toolkit.errors import FormatError, RunFolderError
from toolkit.io.arrays import read_array_tree, write_array_tree
from toolkit.submaps.submap import Submap

_log = logging.getLogger(__name__)

# Number and version, as `_name` writes them.
_NAME = re.compile(r"(\d{4,})_(\d+)")


class SubmapStore:
    """Keeps submaps by number.

    A changed submap gets a folder of its own, so that an older checkpoint still finds what it
    knew; `prune` removes what no checkpoint needs.

    Args:
        folder: where to write them, made when needed; None keeps all in memory.
        budget_mb: memory for those that were put or read last.
    """

    def __init__(self, folder: Path | None = None, budget_mb: float = 500.0) -> None:
        self.folder, self.budget_mb = folder, budget_mb
        self._versions: dict[int, int] = {}
        self._held: dict[int, Submap] = {}  # the least recently used first
        self._sizes_mb: dict[int, float] = {}  # of these; to sum one up takes a while

    @classmethod
    def newest(cls, folder: Path, budget_mb: float = 500.0) -> SubmapStore:
        """The submaps of a folder that a store wrote, each in its last version."""
        store = cls(folder, budget_mb)
        for path in folder.iterdir() if folder.is_dir() else ():
            found = _NAME.fullmatch(path.name)
            if found:
                number, version = int(found[1]), int(found[2])
                store._versions[number] = max(version, store._versions.get(number, 0))
        return store

    def __contains__(self, number: int) -> bool:
        """Whether a submap was ever put."""
        return number in self._versions

    def put(self, submap: Submap) -> None:
        """Keep a submap, or its new content.

        Raises:
            RunFolderError: the disk is full or may not be written.
        """
        number = submap.number
        self._versions[number] = self._versions.get(number, -1) + 1
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_array_tree(self._path(number), *submap.state())
        self._held.pop(number, None)  # its size may have changed
        self._hold(submap)

    def get(self, number: int) -> Submap:
        """A submap; whoever changes it puts it back.

        Raises:
            KeyError: it was never put.
            RunFolderError: its folder is missing.
            FormatError: its folder is damaged.
        """
        if number in self._held:
            submap = self._held[number]
        else:
            self._versions[number]
            tree = read_array_tree(self._path(number))
            try:
                submap = Submap.from_state(tree.arrays, tree.metadata)
            except (KeyError, TypeError, ValueError) as error:
                raise FormatError(
                    f"{self._path(number)} is damaged ({error!r}); run again"
                ) from error
        self._hold(submap)
        return submap

    def state(self) -> dict[str, int]:
        """Versions by number, as JSON holds them."""
        return {str(number): version for number, version in self._versions.items()}

    def restore(self, state: dict[str, int]) -> list[int]:
        """Take over an earlier `state`.

        Returns:
            numbers of the submaps whose folder is missing or damaged; a warning names each.
        """
        self._versions = {int(number): int(version) for number, version in state.items()}
        self._held.clear()
        lost = []
        for number in sorted(self._versions):
            try:
                self.get(number)
            except (FormatError, RunFolderError) as error:
                _log.warning("submap %d is lost, the others go on: %s", number, error)
                lost.append(number)
        return lost

    def prune(self, *states: dict[str, int]) -> None:
        """Remove the folders that neither the given states nor the present one know."""
        if self.folder is None or not self.folder.is_dir():
            return
        known = {_name(int(n), v) for state in (*states, self.state()) for n, v in state.items()}
        for path in self.folder.iterdir():
            if path.name not in known:
                shutil.rmtree(path, ignore_errors=True)

    def _path(self, number: int) -> Path:
        assert self.folder is not None
        return self.folder / _name(number, self._versions[number])

    def _hold(self, submap: Submap) -> None:
        number = submap.number
        if self._held.pop(number, None) is not submap:
            self._sizes_mb[number] = submap.megabytes
        self._held[number] = submap
        if self.folder is None:
            return
        for oldest in list(self._held)[:-1]:
            if sum(self._sizes_mb[n] for n in self._held) <= self.budget_mb:
                return
            del self._held[oldest]


def _name(number: int, version: int) -> str:
    return f"{number:04d}_{version}"
