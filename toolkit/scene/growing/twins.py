"""Objects of several submaps that are one object: their surfaces coincide or touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.voxels import voxel_keys, voxels_of
from toolkit.scene.growing.surfaces import Surfaces

# Minimum number of voxels that two surfaces of one object share.
_MIN_SHARED = 2
# Objects of two submaps are one if they share this share of the smaller one's voxels of this edge.
_SAME_SHARE, _EDGE_M = 0.3, 0.1


class Twins:
    """Finds objects that are one.

    Args:
        surfaces: of all objects.
    """

    def __init__(self, surfaces: Surfaces) -> None:
        self._surfaces = surfaces
        # Coarse voxels by object, with its number of voxels at that time.
        self._coarse: dict[int, tuple[int, NDArray[np.int64]]] = {}

    def moved(self) -> None:
        """Forget the voxels in the world, because poses of submaps were corrected."""
        self._coarse.clear()

    def of(self, number: int, others: list[int], touching: bool = False) -> int:
        """Return the first of some objects of other submaps that is the same one; 0 for none.

        Args:
            number: of the object.
            others: objects of its class.
            touching: those of the same submap count as well; they are one if they share voxels.
        """
        keys, submaps = self._keys(number), self._surfaces.submaps_of(number)
        for other in others:
            same = bool(submaps & self._surfaces.submaps_of(other))
            if other == number or (same and not touching):
                continue
            theirs = self._keys(other)
            shared = len(np.intersect1d(keys, theirs, assume_unique=True))
            least = 0.0 if same else _SAME_SHARE * min(len(keys), len(theirs))
            if shared >= max(_MIN_SHARED, least):
                return other
        return 0

    def _keys(self, number: int) -> NDArray[np.int64]:
        """Ascending numbers of the coarse voxels of an object."""
        known, size = self._coarse.get(number), int(self._surfaces.sizes[number])
        if known is None or known[0] != size:
            points_m = self._surfaces.points_m([number])[number]
            known = size, np.unique(voxel_keys(voxels_of(points_m, _EDGE_M)))
            self._coarse[number] = known
        return known[1]
