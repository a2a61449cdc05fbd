"""What all views say of each place: sums of log probabilities of classes in voxels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.voxels import voxel_keys, voxels_of

Values = NDArray[np.float32]
Keys = NDArray[np.int64]

VOXEL_M = 0.06
# A voxel counts at most this many views, so that later ones can outvote an error.
_MAX_VIEWS = 16


class ClassVotes:
    """Votes of views for the classes of voxels.

    Args:
        classes: number of classes.
    """

    def __init__(self, classes: int) -> None:
        self._keys = np.zeros(0, np.int64)  # ascending
        self._rows = np.zeros(0, np.int64)  # of each key in the tables below
        self._sums = np.zeros((1024, classes), np.float32)
        self._views = np.zeros(1024, np.float32)

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, points: NDArray[np.floating], log_p: Values) -> tuple[Values, Values]:
        """Add one view; a voxel counts once, however many of its points the view shows.

        Args:
            points: [N, 3] in the frame of the map, metres.
            log_p: [N, C] log probabilities of the classes.

        Returns:
            sums [N, C] of the log probabilities of all views, and the number [N] of views.
        """
        keys, inverse, counts = np.unique(
            voxel_keys(voxels_of(points, VOXEL_M)), return_inverse=True, return_counts=True
        )
        order = np.argsort(inverse, kind="stable")
        starts = np.cumsum(counts) - counts
        means = np.add.reduceat(log_p[order], starts, axis=0) / counts[:, None]
        rows = self._rows_of(keys)
        full = self._views[rows] >= _MAX_VIEWS
        self._sums[rows[full]] *= (_MAX_VIEWS - 1) / _MAX_VIEWS
        self._sums[rows] += means
        self._views[rows] = np.minimum(self._views[rows] + 1, _MAX_VIEWS)
        return self._sums[rows][inverse], self._views[rows][inverse]

    def _rows_of(self, keys: Keys) -> NDArray[np.int64]:
        """Rows [U] of ascending keys, which are added where they are new."""
        places = np.searchsorted(self._keys, keys)
        found = np.zeros(len(keys), bool)
        inside = places < len(self._keys)
        found[inside] = self._keys[places[inside]] == keys[inside]
        new = ~found
        first = len(self._keys)
        rows = np.empty(len(keys), np.int64)
        rows[found] = self._rows[places[found]]
        rows[new] = first + np.arange(new.sum())
        self._reserve(first + int(new.sum()))
        self._keys = np.insert(self._keys, places[new], keys[new])
        self._rows = np.insert(self._rows, places[new], rows[new])
        return rows

    def _reserve(self, count: int) -> None:
        while count > len(self._sums):
            self._sums = np.concatenate([self._sums, np.zeros_like(self._sums)])
            self._views = np.concatenate([self._views, np.zeros_like(self._views)])

    def state(self) -> dict[str, NDArray]:
        """Return the arrays that `restore` accepts."""
        return {
            "keys": self._keys,
            "sums": self._sums[self._rows],
            "views": self._views[self._rows],
        }

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._keys = np.array(arrays["keys"])
        self._rows = np.arange(len(self._keys))
        self._reserve(len(self._keys))
        self._sums[: len(self._keys)] = arrays["sums"]
        self._views[: len(self._keys)] = arrays["views"]
