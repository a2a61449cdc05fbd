"""Objects of a finished map, and how its Gaussians pass them on to those of a later map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from toolkit.base.geometry import se3
from toolkit.base.geometry.voxels import voxel_keys, voxels_of
from toolkit.scene.instances.overlapping import overlapping
from toolkit.scene.instances.result import InstanceMap, MapObject
from toolkit.scene.instances.voxels import VoxelVotes
from toolkit.semantics.embedding_fusion import FusedEmbedding, fuse_views

Array = NDArray[np.float64]

# A Gaussian has the object of the nearest one of the finished map within this distance, in metres:
# refinement moves Gaussians by less.
_REACH_M = 0.05
# Edge of the voxels in which the objects of two maps are compared, in metres.
_VOXEL_M = 0.04


@dataclass(frozen=True, eq=False)
class SavedObjects:
    """The objects of a finished map.

    Attributes:
        objects: in the order of their numbers.
        points_m: [N, 3] centres of its Gaussians.
        ids: [N] int32, their objects, 0 for none.
        submap: [N] int32, their submaps.
        model: name of the model of the objects' embeddings, empty if unknown.
    """

    objects: list[MapObject]
    points_m: Array
    ids: NDArray[np.int32]
    submap: NDArray[np.int32]
    model: str = ""

    def of(self, number: int, points_m: Array, T_saved_points: Array | None = None) -> NDArray:
        """Return the objects [M] int32 of Gaussians that a submap has now, 0 for none.

        Args:
            number: of the submap.
            points_m: [M, 3] their centres.
            T_saved_points: [4, 4] from their frame to that of the finished map.
        """
        own = self.submap == number
        found = np.zeros(len(points_m), np.int32)
        if own.any() and len(points_m):
            if T_saved_points is not None:
                points_m = se3.transform_points(T_saved_points, points_m)
            reach = cKDTree(self.points_m[own]).query(points_m, distance_upper_bound=_REACH_M)
            near = np.isfinite(reach[0])
            found[near] = self.ids[own][reach[1][near]]
        return found

    def renumbered(self, submaps: Sequence[int]) -> SavedObjects:
        """Return the Gaussians of some submaps, which are numbered in their order."""
        places = np.full(len(self.submap), -1, np.int32)
        for place, number in enumerate(submaps):
            places[self.submap == number] = place
        kept = places >= 0
        return replace(self, points_m=self.points_m[kept], ids=self.ids[kept], submap=places[kept])

    def votes(self, voxel_m: float) -> VoxelVotes:
        """The object with most Gaussians in each voxel."""
        known = self.ids > 0
        keys = voxel_keys(voxels_of(self.points_m[known], voxel_m))
        rows = np.stack([keys, self.ids[known].astype(np.int64)])
        (keys, ids), counts = np.unique(rows, axis=1, return_counts=True)
        order = np.lexsort((ids, -counts, keys))
        first = order[np.unique(keys[order], return_index=True)[1]]
        votes = VoxelVotes(voxel_m)
        votes.add(keys[first], ids[first].astype(np.int32))
        return votes

    def carried(
        self, ids: Mapping[int, NDArray[np.int32]], separate_parts: bool = False
    ) -> InstanceMap:
        """Return the objects that a later map has, with their new numbers of Gaussians.

        Args:
            ids: objects of the Gaussians of each submap.
            separate_parts: the parts of the map beside the main one remain as they are: keep the
                objects that no Gaussian of the main part had.
        """
        counts = np.zeros(max([o.number for o in self.objects], default=0) + 1, np.int64)
        for part in ids.values():
            counts += np.bincount(part, minlength=len(counts))
        here = set(np.unique(self.ids).tolist())
        objects = []
        for one in self.objects:
            if counts[one.number]:
                objects.append(replace(one, gaussians=int(counts[one.number])))
            elif separate_parts and one.number not in here:
                objects.append(one)
        return InstanceMap(objects, dict(ids), self.model)


def joined(first: SavedObjects, second: SavedObjects, T_first_second: Array) -> SavedObjects:
    """Join the objects of two maps where they overlap; those of the first keep their numbers.

    Args:
        first, second: the objects of both; submaps of the second have other numbers.
        T_first_second: [4, 4] from the frame of the second map to that of the first.
    """
    moved = replace(second, points_m=se3.transform_points(T_first_second, second.points_m))
    names = {
        side: {one.number: one.class_name for one in objects.objects}
        for side, objects in (("first", first), ("second", second))
    }
    pairs = overlapping(
        first.votes(_VOXEL_M), moved.votes(_VOXEL_M), names["first"].get, names["second"].get
    )
    table = np.zeros(max([one.number for one in second.objects], default=0) + 1, np.int32)
    taken: set[int] = set()
    for _, a, b in sorted(pairs, key=lambda row: (-row[0], row[1:])):
        if a not in taken and not table[b]:
            table[b] = a
            taken.add(a)
    found = {one.number: one for one in first.objects}
    for one in second.objects:
        number = int(table[one.number]) or max(found, default=0) + 1
        table[one.number] = number
        found[number] = _both(found.get(number), replace(one, number=number))
    models = {one.model for one in (first, second) if any(o.embedding for o in one.objects)}
    same = len(models) <= 1
    return SavedObjects(
        [one if same else replace(one, embedding=None) for _, one in sorted(found.items())],
        np.concatenate([first.points_m, moved.points_m]),
        np.concatenate([first.ids, table[second.ids]]),
        np.concatenate([first.submap, second.submap]),
        "".join(models) if same else "",
    )


def _both(one: MapObject | None, other: MapObject) -> MapObject:
    """An object that two maps have; the frames are those of the first."""
    if one is None:
        return other
    views = one.views + other.views
    score = (one.views * one.score + other.views * other.score) / max(views, 1)
    return replace(
        one,
        class_name=one.class_name or other.class_name,
        score=score,
        views=views,
        embedding=_fused(one.embedding, other.embedding),
    )


def _fused(one: FusedEmbedding | None, other: FusedEmbedding | None) -> FusedEmbedding | None:
    known = [e for e in (one, other) if e is not None]
    if len({len(e.embedding) for e in known}) != 1:
        return None
    return fuse_views(np.stack([e.embedding for e in known]), np.array([e.weight for e in known]))
