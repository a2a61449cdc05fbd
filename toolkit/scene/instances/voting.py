"""Objects of the Gaussians: the keyframes vote, as they do for labels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from toolkit.base.geometry import se3
from toolkit.base.geometry.depth_lookup import depths_at
from toolkit.base.keyframe import Keyframe
from toolkit.scene.instances.association import COVERED, Overlaps
from toolkit.scene.instances.records import KeyframeMasks
from toolkit.scene.instances.voxels import MaskedVoxels, VoxelVotes, sampling_step

Array = NDArray[np.float64]

# Distance of a Gaussian's centre from the measured surface up to which a pixel shows it: an offset
# in metres, and a fraction of the depth.
_TOLERANCE_M, _TOLERANCE = 0.02, 0.015
# A mask shows several objects if it covers two that have this share of its voxels each.
_SHARE = 0.1
# Votes are summed when there are this many.
_MAX_VOTES = 1 << 22


@dataclass(frozen=True, eq=False)
class MaskedKeyframe:
    """A keyframe with its masks.

    Attributes:
        keyframe: with its images.
        T_world_camera: [4, 4] final pose in the frame of the part of the map.
        record: its masks.
        objects: [K] final object of each mask, 0 for none.
    """

    keyframe: Keyframe
    T_world_camera: Array
    record: KeyframeMasks
    objects: NDArray[np.int32]

    def seen(self, voxel_m: float) -> MaskedVoxels:
        """The voxels of the masks in the world."""
        keyframe = self.keyframe
        depth_m = keyframe.depth_m.numpy()
        pose = self.T_world_camera
        return MaskedVoxels.of(self.record.ids, depth_m, keyframe.camera, pose, voxel_m)

    def several(self, votes: VoxelVotes) -> NDArray[np.bool_]:
        """Mask [K] of the masks that show several objects."""
        seen = self.seen(votes.voxel_m)
        count = len(self.objects)
        overlaps = Overlaps.of(seen, votes, votes.rows_of(seen), count)
        inside = overlaps.covered >= COVERED
        inside &= overlaps.shared >= _SHARE * overlaps.size[:, None]
        return np.asarray(inside[1:].sum(axis=1) >= 2)


class GaussianVotes:
    """Counts votes for the objects of Gaussians.

    Args:
        means: [N, 3] centres in the world.
        votes: objects by voxel in the world.
        objects: number of objects M.
        known: [N] objects of the Gaussians without votes; by default, those of their voxels.
    """

    def __init__(
        self,
        means: Array,
        votes: VoxelVotes,
        objects: int,
        known: NDArray[np.int32] | None = None,
    ) -> None:
        self._means, self._votes, self._objects = means, votes, objects
        self._owner = votes.owner_at(means) if known is None else known
        self._cells: list[NDArray[np.int64]] = []
        self._counts: list[NDArray[np.int64]] = []
        self._pending = 0

    def add(self, masked: MaskedKeyframe) -> None:
        """Add the votes of a keyframe."""
        index, row, column = self._visible(masked)
        step = sampling_step(masked.keyframe.camera.width)
        ids = masked.record.ids
        row, column = (
            np.rint((pixel - step // 2) / step).astype(np.intp).clip(0, samples - 1)
            for pixel, samples in zip((row, column), ids.shape, strict=True)
        )
        mask = ids[row, column]
        found = np.concatenate([[0], masked.objects])[mask].astype(np.int64)
        # A mask of several objects cannot say which one a Gaussian belongs to; the voxels can.
        several = np.concatenate([[False], masked.several(self._votes)])[mask]
        owner = self._owner[index]
        found = np.where(several & (owner > 0), owner, found)
        inside = found > 0
        cells = index[inside].astype(np.int64) * (self._objects + 1) + found[inside]
        self._cells.append(cells)
        self._counts.append(np.ones_like(cells))
        self._pending += len(cells)
        if self._pending > _MAX_VOTES:
            self._sum()

    def _visible(
        self, masked: MaskedKeyframe
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Indices, rows and columns of the Gaussians on the surface that a keyframe measured."""
        keyframe = masked.keyframe
        points = se3.transform_points(se3.inverse(masked.T_world_camera), self._means)
        at = depths_at(points, keyframe.depth_m.numpy(), keyframe.camera, _TOLERANCE_M)
        near = np.abs(at.z_m - at.depth_m) <= _TOLERANCE_M + _TOLERANCE * at.depth_m
        near &= at.depth_m > 0
        return at.index[near], at.row[near], at.column[near]

    def _sum(self) -> None:
        cells, inverse = np.unique(np.concatenate(self._cells), return_inverse=True)
        counts = np.bincount(inverse, np.concatenate(self._counts)).astype(np.int64)
        self._cells, self._counts, self._pending = [cells], [counts], 0

    def winners(
        self, kept: NDArray[np.bool_] | None = None, fill: bool = True
    ) -> NDArray[np.int32]:
        """The object [N] with most votes of each Gaussian, 0 for none.

        Gaussians without votes belong to the object of their voxel.

        Args:
            kept: [M + 1] objects to choose from; all by default.
            fill: give Gaussians without votes the object of the nearest one within a voxel.
        """
        if not self._cells:
            return self._kept_owner(kept)
        self._sum()
        gaussian, number = np.divmod(self._cells[0], self._objects + 1)
        counts = self._counts[0]
        if kept is not None:
            chosen = kept[number]
            gaussian, number, counts = gaussian[chosen], number[chosen], counts[chosen]
        order = np.lexsort((number, -counts, gaussian))
        first = order[np.unique(gaussian[order], return_index=True)[1]]
        found = self._kept_owner(kept)
        found[gaussian[first]] = number[first]
        return self._filled(found) if fill else found

    def _filled(self, found: NDArray[np.int32]) -> NDArray[np.int32]:
        """Give Gaussians without an object that of the nearest one within a voxel.

        Masks often end before the objects do.
        """
        missing, known = np.flatnonzero(found == 0), np.flatnonzero(found)
        if not len(missing) or not len(known):
            return found
        tree = cKDTree(self._means[known])
        reach = self._votes.voxel_m
        distances, nearest = tree.query(self._means[missing], distance_upper_bound=reach)
        near = np.isfinite(distances)
        found[missing[near]] = found[known[nearest[near]]]
        return found

    def _kept_owner(self, kept: NDArray[np.bool_] | None) -> NDArray[np.int32]:
        if kept is None:
            return self._owner.copy()
        return np.where(kept[self._owner], self._owner, 0).astype(np.int32)


def masked_keyframes(
    keyframes: Iterable[tuple[Keyframe, Array]],
    records: Sequence[KeyframeMasks],
    table: NDArray[np.int32],
) -> Iterator[MaskedKeyframe]:
    """The keyframes of a submap that have masks.

    Args:
        keyframes: with their poses in the world.
        records: masks of the submap's keyframes.
        table: [M + 1] final object of every object.
    """
    by_index = {record.index: record for record in records}
    for keyframe, T_world_camera in keyframes:
        record = by_index.get(keyframe.index)
        if record is not None:
            yield MaskedKeyframe(keyframe, T_world_camera, record, table[record.objects])
