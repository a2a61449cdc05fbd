"""Access to the submaps of a finished run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.submaps.store import SubmapStore
from toolkit.submaps.submap import Submap


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
