"""Objects of several submaps that are one object: their surfaces coincide or touch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.voxels import voxel_keys, voxels_of
from toolkit.scene.growing.objects import GrowingObject

Array = NDArray[np.float64]
Keys = NDArray[np.int64]

# Minimum number of voxels that two surfaces of one object share.
MIN_SHARED = 2
# Objects of two submaps are one if they share this share of the smaller one's voxels of this edge.
_SAME_SHARE, _SAME_EDGES = 0.3, 2.0


class Twins:
    """Finds objects that are one.

    Args:
        objects: the objects by number; changes of the dictionary are seen.
        voxel_m: edge of their voxels.
    """

    def __init__(self, objects: Mapping[int, GrowingObject], voxel_m: float) -> None:
        self._objects, self._edge_m = objects, _SAME_EDGES * voxel_m
        # Coarse voxels by object and submap, with the pixels at that time.
        self._coarse: dict[tuple[int, int], tuple[int, Keys]] = {}

    def moved(self) -> None:
        """Forget the voxels in the world, because poses of submaps were corrected."""
        self._coarse.clear()

    def of(self, number: int, submap: int, poses: Mapping[int, Array]) -> int:
        """Return the object of another submap that is the same one; 0 for none.

        Args:
            number: of the object.
            submap: in which the object is compared.
            poses: [4, 4] pose of each submap, in metres.
        """
        return self._twin(number, submap, self._keys(number, submap, poses), poses)

    def pairs(self, poses: Mapping[int, Array]) -> Iterator[tuple[int, int]]:
        """Yield objects of one class whose surfaces coincide or touch, the lower number first.

        The caller merges each pair before it takes the next one.
        """
        for number in sorted(self._objects):
            while number in self._objects:
                parts = self._objects[number].fragments
                keys = {s: self._keys(number, s, poses) for s in parts}
                found = (self._twin(number, s, own, poses, True) for s, own in keys.items())
                other = next((n for n in found if n), 0)
                if not other:
                    break
                yield min(number, other), max(number, other)

    def _twin(
        self,
        number: int,
        submap: int,
        keys: Keys,
        poses: Mapping[int, Array],
        touching: bool = False,
    ) -> int:
        """The object of the same class in other submaps that shares enough voxels; 0 for none.

        Pieces in the same submap count if `touching`; they touch if they share voxels.
        """
        class_id = self._objects[number].class_id
        for other, one in self._objects.items():
            if other == number or one.class_id != class_id:
                continue
            for elsewhere in one.fragments:
                same = elsewhere == submap
                if same and not touching:
                    continue
                theirs = self._keys(other, elsewhere, poses)
                shared = len(np.intersect1d(keys, theirs, assume_unique=True))
                least = 0.0 if same else _SAME_SHARE * min(len(keys), len(theirs))
                if shared >= max(MIN_SHARED, least):
                    return other
        return 0

    def _keys(self, number: int, submap: int, poses: Mapping[int, Array]) -> Keys:
        """Ascending numbers of the coarse voxels of an object's surface in a submap."""
        part = self._objects[number].fragments[submap]
        known, pixels = self._coarse.get((number, submap)), part.pixels
        if known is None or known[0] != pixels:
            points = se3.transform_points(poses[submap], part.points_m(1))
            known = pixels, np.unique(voxel_keys(voxels_of(points, self._edge_m)))
            self._coarse[number, submap] = known
        return known[1]
