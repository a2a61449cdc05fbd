"""The surfaces of tracked objects: voxels that masks voted for, in the world.

An object of the scene consists of parts: objects of the tracker in one or several submaps.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.voxels import voxels_of_keys
from toolkit.scene.instances.tracking import InstanceTracker

Array = NDArray[np.float64]

# Voxels with one vote are noise in objects with at least this many views.
_SETTLED_VIEWS = 4


class Surfaces:
    """Reads objects from a tracker.

    Args:
        tracker: follows objects.

    Attributes:
        poses: [4, 4] pose of each submap, in metres, by its number.
        twins: objects of the tracker that are another one, by number.
        table: [M + 1] the object of the scene of each object of the tracker, since the last `read`.
        sizes: [M + 1] number of voxels of each object of the scene, since then.
        parts: objects of the tracker of each object of the scene, since then.
        metres_per_unit: length of the unit of the tracker, since then.
    """

    def __init__(self, tracker: InstanceTracker) -> None:
        self._tracker = tracker
        self.poses: dict[int, Array] = {}
        self.twins: dict[int, int] = {}
        self.table = np.zeros(1, np.int32)
        self.sizes = np.zeros(1, np.int64)
        self.parts: dict[int, list[int]] = {}
        self.metres_per_unit = 1.0

    def read(self, metres_per_unit: float) -> None:
        """Follow what the tracker has found and merged."""
        tracker = self._tracker
        self.metres_per_unit = metres_per_unit
        self.table = np.array([self._object_of(n) for n in tracker.table().tolist()], np.int32)
        self.sizes = np.zeros(len(self.table), np.int64)
        for votes in tracker.votes.values():
            self.sizes += np.bincount(self.table[votes.owners[:, 0]], minlength=len(self.table))
        self.sizes[0] = 0
        self.parts = {}
        for number in tracker.objects:
            self.parts.setdefault(int(self.table[number]), []).append(number)

    def submaps_of(self, number: int) -> set[int]:
        """The submaps in which an object was seen."""
        return {self._tracker.objects[part].submap for part in self.parts[number]}

    def views(self, number: int) -> int:
        """The number of masks of an object."""
        return sum(self._tracker.objects[part].views for part in self.parts[number])

    def points_m(self, numbers: Iterable[int]) -> dict[int, Array]:
        """The voxels [n, 3] of some objects in the world."""
        found: dict[int, list[tuple[Array, NDArray[np.bool_]]]] = {n: [] for n in numbers}
        wanted = np.isin(np.arange(len(self.table)), list(found))
        for submap, votes in sorted(self._tracker.votes.items()):
            owners = self.table[votes.owners[:, 0]]
            rows = np.flatnonzero(wanted[owners])
            if not len(rows):
                continue
            rows = rows[np.argsort(owners[rows], kind="stable")]
            edge_m = votes.voxel_m * self.metres_per_unit
            points = (voxels_of_keys(votes.keys[rows]) + 0.5) * edge_m
            points = se3.transform_points(self.poses[submap], points)
            sure = votes.votes[rows, 0] > 1
            starts = np.flatnonzero(np.diff(owners[rows], prepend=-1))
            for a, b in zip(starts, [*starts[1:], len(rows)], strict=True):
                found[int(owners[rows[a]])].append((points[a:b], sure[a:b]))
        return {number: self._without_noise(number, parts) for number, parts in found.items()}

    def _without_noise(
        self, number: int, parts: Sequence[tuple[Array, NDArray[np.bool_]]]
    ) -> Array:
        points = np.concatenate([np.zeros((0, 3)), *(own for own, _ in parts)])
        sure = np.concatenate([np.zeros(0, bool), *(own for _, own in parts)])
        settled = sure.any() and self.views(number) >= _SETTLED_VIEWS
        return points[sure] if settled else points

    def _object_of(self, number: int) -> int:
        while number in self.twins:
            number = self._tracker.current(self.twins[number])
        return number
