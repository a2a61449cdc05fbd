"""The submaps of a finished run, to be read again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.submaps.store import SubmapStore
from toolkit.submaps.submap import Submap


class SavedSubmaps(Mapping[int, Submap]):
    """Submaps by number, read from disk when they are asked for.

    Args:
        store: has them all.
        anchors: T_world_submap [4, 4] of each at the end of the run. A submap's own file may
            hold an older one: loops that are closed later move anchors alone.
    """

    def __init__(self, store: SubmapStore, anchors: Mapping[int, NDArray[np.float64]]) -> None:
        self._store, self._anchors = store, dict(sorted(anchors.items()))

    def __getitem__(self, number: int) -> Submap:
        """A submap at its final place.

        Raises:
            KeyError: there is no such submap.
            ToolkitError: its folder is missing or damaged.
        """
        anchor = self._anchors[number]
        submap = self._store.get(number)
        submap.T_world_submap = anchor.copy()
        return submap

    def __iter__(self) -> Iterator[int]:
        return iter(self._anchors)

    def __len__(self) -> int:
        return len(self._anchors)
