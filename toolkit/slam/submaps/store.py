"""Storage of inactive submaps: on disk, with the recently used ones cached in memory."""

from __future__ import annotations

import logging
import re
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.io.arrays import compress_array_tree, read_array_tree, write_array_tree
from toolkit.slam.submaps.submap import Submap

_log = logging.getLogger(__name__)

# Submap number and version in the folder names of `_name`.
_NAME = re.compile(r"(\d{4,})_(\d+)")


class SubmapStore:
    """Stores submaps by number.

    Each version of a submap is written to a separate folder, so that older checkpoints remain
    valid; `prune` removes the folders that no checkpoint needs.

    Args:
        folder: where to write the submaps, created when needed; None keeps all in memory.
        budget_mb: size of the LRU cache in MB.
    """

    def __init__(self, folder: Path | None = None, budget_mb: float = 500.0) -> None:
        self.folder, self.budget_mb = folder, budget_mb
        self._versions: dict[int, int] = {}
        self._cache: dict[int, Submap] = {}  # least recently used first
        self._sizes_mb: dict[int, float] = {}  # of the cached submaps; slow to compute

    @classmethod
    def newest(cls, folder: Path, budget_mb: float = 500.0) -> SubmapStore:
        """Open a folder written by a store, with the newest version of each submap."""
        store = cls(folder, budget_mb)
        for path in folder.iterdir() if folder.is_dir() else ():
            found = _NAME.fullmatch(path.name)
            if found:
                number, version = int(found[1]), int(found[2])
                store._versions[number] = max(version, store._versions.get(number, 0))
        return store

    def __contains__(self, number: int) -> bool:
        """Whether a submap is stored."""
        return number in self._versions

    def put(self, submap: Submap) -> None:
        """Store a submap or a new version of it.

        Raises:
            RunFolderError: the disk is full or not writable.
        """
        number = submap.number
        self._versions[number] = self._versions.get(number, -1) + 1
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_array_tree(self._path(number), *submap.state())
        self._cache.pop(number, None)  # its size may have changed
        self._add_to_cache(submap)

    def get(self, number: int) -> Submap:
        """Return a submap; call `put` after changing it.

        Raises:
            KeyError: no submap with this number is stored.
            RunFolderError: the submap's folder is missing.
            FormatError: the submap's folder is damaged.
        """
        if number in self._cache:
            submap = self._cache[number]
        else:
            self._versions[number]
            tree = read_array_tree(self._path(number))
            try:
                submap = Submap.from_state(tree.arrays, tree.metadata)
            except (KeyError, TypeError, ValueError) as error:
                raise FormatError(
                    f"{self._path(number)} is damaged ({error!r}); run again"
                ) from error
        self._add_to_cache(submap)
        return submap

    def take(self, number: int) -> Submap:
        """Return a submap to be changed until it is `put` again; raises as `get`.

        The stored version stays valid, and the submap no longer counts for the cache.
        """
        submap = self.get(number)
        del self._cache[number]
        return submap

    def give_back(self, submap: Submap) -> None:
        """Return a submap from `take` without changes; the stored version is still valid."""
        self._add_to_cache(submap)

    def state(self) -> dict[str, int]:
        """Versions by submap number, with the keys as strings for JSON."""
        return {str(number): version for number, version in self._versions.items()}

    def restore(self, state: dict[str, int]) -> list[int]:
        """Restore an earlier `state`.

        Returns:
            Numbers of the submaps whose folder is missing or damaged; a warning is logged for each.
        """
        self._versions = {int(number): int(version) for number, version in state.items()}
        self._cache.clear()
        lost = []
        for number in sorted(self._versions):
            try:
                self.get(number)
            except (FormatError, RunFolderError) as error:
                _log.warning("Submap %d cannot be read and is skipped: %s", number, error)
                lost.append(number)
        return lost

    def prune(self, *states: dict[str, int]) -> None:
        """Remove the folders that neither the given states nor the current state need."""
        if self.folder is None or not self.folder.is_dir():
            return
        needed = {_name(int(n), v) for state in (*states, self.state()) for n, v in state.items()}
        for path in self.folder.iterdir():
            if path.name not in needed:
                shutil.rmtree(path, ignore_errors=True)

    def compress(self) -> None:
        """Compress the stored submaps, which are read as before; they take half the space."""
        if self.folder is None:
            return
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # zlib releases the GIL
            jobs = [pool.submit(compress_array_tree, self._path(n)) for n in self._versions]
        for error in filter(None, (job.exception() for job in jobs)):
            _log.warning("A submap stays uncompressed: %s", error)

    def _path(self, number: int) -> Path:
        assert self.folder is not None
        return self.folder / _name(number, self._versions[number])

    def _add_to_cache(self, submap: Submap) -> None:
        number = submap.number
        if self._cache.pop(number, None) is not submap:
            self._sizes_mb[number] = submap.size_mb
        self._cache[number] = submap
        if self.folder is None:
            return
        for oldest in list(self._cache)[:-1]:
            if sum(self._sizes_mb[n] for n in self._cache) <= self.budget_mb:
                return
            del self._cache[oldest]


def _name(number: int, version: int) -> str:
    return f"{number:04d}_{version}"


class SavedSubmaps(Mapping[int, Submap]):
    """Submaps by number, read from disk on access.

    Args:
        store: contains all submaps.
        anchors: T_world_submap [4, 4] of each submap at the end of the run. The pose in a submap's
            file may be older, because later loop closures do not rewrite the file.
    """

    def __init__(self, store: SubmapStore, anchors: Mapping[int, NDArray[np.float64]]) -> None:
        self._store, self._anchors = store, dict(sorted(anchors.items()))

    def __getitem__(self, number: int) -> Submap:
        """Read a submap; its anchor has the final pose.

        Raises:
            KeyError: there is no submap with this number.
            ToolkitError: the submap's folder is missing or damaged.
        """
        anchor = self._anchors[number]
        submap = self._store.get(number)
        submap.T_world_submap = anchor.copy()
        return submap

    def __iter__(self) -> Iterator[int]:
        return iter(self._anchors)

    def __len__(self) -> int:
        return len(self._anchors)
