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
        table: [M + 1] object of the scene of each object of the tracker, since the last `group`.
        sizes: [M + 1] number of voxels of each object of the scene, since then.
        parts: objects of the tracker of each object of the scene, since then.
        metres_per_unit: length of the unit of the tracker, since the last `read`.
    """

    def __init__(self, tracker: InstanceTracker) -> None:
        self._tracker = tracker
        self.poses: dict[int, Array] = {}
        self.twins: dict[int, int] = {}
        self.table = np.zeros(1, np.int32)
        self.sizes = np.zeros(1, np.int64)
        self.parts: dict[int, list[int]] = {}
        self.metres_per_unit = 1.0
        # Voxels of each object of the tracker, by submap.
        self._counts: dict[int, NDArray[np.int64]] = {}

    def read(self, metres_per_unit: float, submap: int | None = None) -> None:
        """Count the voxels of the tracker's objects.

        Args:
            metres_per_unit: length of the unit of the tracker.
            submap: the only one whose voxels have changed; None for any.
        """
        self.metres_per_unit = metres_per_unit
        for number, votes in self._tracker.votes.items():
            if submap in (None, number) or number not in self._counts:
                self._counts[number] = np.bincount(votes.owners[:, 0], minlength=1)

    def group(self) -> None:
        """Find the objects of the scene: what the tracker has merged, and twins, are one."""
        tracker = self._tracker
        self.table = tracker.table(self.twins)
        sizes = np.zeros(len(self.table))
        for counts in self._counts.values():
            sizes += np.bincount(self.table[: len(counts)], counts, len(sizes))
        self.sizes = sizes.astype(np.int64)
        self.sizes[0] = 0
        self.parts = {}
        owners = self.table.tolist()
        for number in tracker.objects:
            self.parts.setdefault(owners[number], []).append(number)

    def submaps_of(self, number: int) -> set[int]:
        """The submaps in which an object was seen."""
        return {self._tracker.objects[part].submap for part in self.parts[number]}

    def views(self, number: int) -> int:
        """The number of masks of an object."""
        return sum(self._tracker.objects[part].views for part in self.parts[number])

    def points_m(self, numbers: Iterable[int]) -> dict[int, Array]:
        """The voxels [n, 3] of some objects in the world."""
        found: dict[int, list[tuple[Array, NDArray[np.bool_]]]] = {n: [] for n in numbers}
        wanted = np.isin(self.table, list(found))
        for submap, votes in sorted(self._tracker.votes.items()):
            if not wanted[np.flatnonzero(self._counts[submap])].any():
                continue
            rows = np.flatnonzero(wanted[votes.owners[:, 0]])
            owners = self.table[votes.owners[rows, 0]]
            order = np.argsort(owners, kind="stable")
            rows, owners = rows[order], owners[order]
            edge_m = votes.voxel_m * self.metres_per_unit
            points = (voxels_of_keys(votes.keys[rows]) + 0.5) * edge_m
            points = se3.transform_points(self.poses[submap], points)
            sure = votes.votes[rows, 0] > 1
            starts = np.flatnonzero(np.diff(owners, prepend=-1))
            for a, b in zip(starts, [*starts[1:], len(rows)], strict=True):
                found[int(owners[a])].append((points[a:b], sure[a:b]))
        return {number: self._without_noise(number, parts) for number, parts in found.items()}

    def _without_noise(
        self, number: int, parts: Sequence[tuple[Array, NDArray[np.bool_]]]
    ) -> Array:
        points = np.concatenate([np.zeros((0, 3)), *(own for own, _ in parts)])
        sure = np.concatenate([np.zeros(0, bool), *(own for _, own in parts)])
        settled = sure.any() and self.views(number) >= _SETTLED_VIEWS
        return points[sure] if settled else points
