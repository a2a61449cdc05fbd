"""Voxels that the masks of a keyframe cover, and votes of keyframes for the objects in voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.voxels import voxel_keys, voxels_of

Array = NDArray[np.float64]
Keys = NDArray[np.int64]

# Masks are compared on every n-th pixel in each direction, so that about this width remains.
SAMPLED_WIDTH = 160
# Number of voxels that are sorted among each other before all are sorted.
_MAX_NEW = 1 << 14
# Limit of a voxel's votes for an object, so that later evidence can outvote an error.
_MAX_VOTES = 8
# Depth noise of an RGB-D camera in metres: offset, factor of the squared distance, and the
# distance where it is smallest (Nguyen, Izadi and Lovell, 2012).
_NOISE_M, _NOISE_PER_M, _NOISE_FROM_M = 0.0012, 0.0019, 0.4


def sampling_step(width: int) -> int:
    """Distance between the sampled pixels of an image of a width."""
    return max(1, round(width / SAMPLED_WIDTH))


def sampled(image: NDArray, step: int) -> NDArray:
    """Every step-th pixel of an image [..., H, W] in each direction, as in `Camera.unproject`."""
    return image[..., step // 2 :: step, step // 2 :: step]


@dataclass(frozen=True, eq=False)
class MaskedVoxels:
    """The voxels that a keyframe sees, each with the mask of most of its pixels.

    Attributes:
        keys: [E] ascending numbers of voxels.
        mask: [E] int32 mask of each voxel, 0 for none.
        points: [E, 3] centre of each voxel, in the frame of the votes.
        camera: [3] centre of the camera.
        noise: [E] standard deviation of the depth there.
    """

    keys: Keys
    mask: NDArray[np.int32]
    points: Array
    camera: Array
    noise: Array

    @classmethod
    def of(
        cls,
        ids: NDArray[np.integer],
        depth_m: NDArray[np.float32],
        camera: Camera,
        T_votes_camera: Array,
        voxel_m: float,
    ) -> MaskedVoxels:
        """Unproject sampled masks.

        Args:
            ids: [h, w] masks of the sampled pixels.
            depth_m: [H, W] of all pixels, 0 where missing.
            camera: of all pixels.
            T_votes_camera: [4, 4] pose in the frame of the votes.
            voxel_m: edge of a voxel.
        """
        step = sampling_step(camera.width)
        in_camera = camera.unproject(depth_m, step).reshape(-1, 3)
        known = in_camera[:, 2] > 0
        points = se3.transform_points(T_votes_camera, in_camera[known])
        mask = ids.reshape(-1)[known].astype(np.int64)
        if not len(points):
            none = np.zeros((0, 3))
            return cls(np.zeros(0, np.int64), np.zeros(0, np.int32), none, np.zeros(3), none[:, 0])
        voxels = voxels_of(points, voxel_m)
        # One sort of plain numbers: voxels by x, y and z within their bounding box, and masks.
        columns = np.ascontiguousarray(voxels.T)
        low = columns.min(axis=1)
        _, height, depth = (columns.max(axis=1) - low + 1).tolist()
        x, y, z = columns - low[:, None]
        masks = int(mask.max()) + 1
        cells = np.sort(((x * height + y) * depth + z) * masks + mask)
        starts = np.flatnonzero(_changes(cells))
        counts = np.diff(np.append(starts, len(cells)))
        local, mask = np.divmod(cells[starts], masks)
        # The mask with most pixels of each voxel, the first one if several have as many.
        voxel = np.flatnonzero(_changes(local))
        most = np.repeat(np.maximum.reduceat(counts, voxel), np.diff(np.append(voxel, len(local))))
        best = np.flatnonzero(counts == most)
        best = best[_changes(local[best])]
        local, mask = local[best], mask[best]
        found = np.stack([local // (height * depth), local // depth % height, local % depth], 1)
        centres = (found + low + 0.5) * voxel_m
        z_m = (centres - T_votes_camera[:3, 3]) @ T_votes_camera[:3, 2]
        return cls(
            voxel_keys(found + low),
            mask.astype(np.int32),
            centres,
            T_votes_camera[:3, 3],
            _NOISE_M + _NOISE_PER_M * (z_m - _NOISE_FROM_M) ** 2,
        )

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self.keys)

    def distances(self, masks: int) -> Array:
        """Mean distance [K] of the voxels of each mask from the camera, 0 for masks without any."""
        metres = np.linalg.norm(self.points - self.camera, axis=1)
        count = np.bincount(self.mask, minlength=masks + 1)
        total = np.bincount(self.mask, metres, masks + 1)
        return np.asarray(total / np.maximum(count, 1))[1:]


def _changes(values: NDArray) -> NDArray[np.bool_]:
    """Mask of the places of sorted values where a new value starts."""
    changed = np.ones(len(values), bool)
    changed[1:] = values[1:] != values[:-1]
    return changed


class _VoxelIndex:
    """Finds the rows of voxels; rows are numbered in the order in which voxels are added.

    New voxels are sorted among the newest ones, and all together once there are many, so that a
    keyframe does not move all voxels of a large submap.
    """

    def __init__(self) -> None:
        none = np.zeros(0, np.int64), np.zeros(0, np.int32)
        self._old, self._new = none, none

    def find(self, keys: Keys) -> NDArray[np.int32]:
        """The row [E] of each voxel, -1 where there is none."""
        rows = np.full(len(keys), -1, np.int32)
        for known, places in (self._old, self._new):
            if len(known):
                place = np.minimum(np.searchsorted(known, keys), len(known) - 1)
                rows = np.where(known[place] == keys, places[place], rows)
        return rows

    def append(self, keys: Keys) -> None:
        """Add voxels that are not known yet."""
        first = len(self._old[0]) + len(self._new[0])
        rows = np.arange(first, first + len(keys), dtype=np.int32)
        self._new = _sorted_by_key(self._new, (keys, rows))
        if len(self._new[0]) > _MAX_NEW:
            self._old, self._new = _sorted_by_key(self._old, self._new), _VoxelIndex()._new


def _sorted_by_key(
    one: tuple[Keys, NDArray[np.int32]], other: tuple[Keys, NDArray[np.int32]]
) -> tuple[Keys, NDArray[np.int32]]:
    keys = np.concatenate([one[0], other[0]])
    order = np.argsort(keys, kind="stable")
    return keys[order], np.concatenate([one[1], other[1]])[order]


class _Rows:
    """An array that grows by rows, with room for more, so that appending rarely copies."""

    def __init__(self, columns: tuple[int, ...], dtype: type) -> None:
        self._room: NDArray = np.zeros((0, *columns), dtype)
        self._count = 0

    @property
    def rows(self) -> NDArray:
        """All rows, which can be written to."""
        return self._room[: self._count]

    def append(self, added: NDArray) -> None:
        """Add rows at the end."""
        count = self._count + len(added)
        if count > len(self._room):
            room = np.zeros((max(count, 2 * len(self._room)), *self._room.shape[1:]), added.dtype)
            room[: self._count] = self.rows
            self._room = room
        self._room[self._count : count] = added
        self._count = count


class VoxelVotes:
    """Votes of keyframes for the objects in voxels: the two objects with most votes per voxel.

    The counts are those of Misra and Gries (1982): a vote for a third object lowers the count of
    the second one. Memory therefore does not depend on the number of objects and keyframes.

    Attributes:
        voxel_m: edge of a voxel.
    """

    def __init__(self, voxel_m: float) -> None:
        self.voxel_m = voxel_m
        self._index = _VoxelIndex()
        self._keys, self._owners = _Rows((), np.int64), _Rows((2,), np.int32)
        self._votes = _Rows((2,), np.int32)

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self.keys)

    @property
    def keys(self) -> Keys:
        """Numbers [V] of the voxels, in the order in which they were added."""
        return self._keys.rows

    @property
    def owners(self) -> NDArray[np.int32]:
        """The objects [V, 2] of the voxels, 0 for none; the first has most votes."""
        return self._owners.rows

    @property
    def votes(self) -> NDArray[np.int32]:
        """The votes [V, 2] for them."""
        return self._votes.rows

    def add(
        self, keys: Keys, objects: NDArray[np.int32], rows: NDArray[np.int32] | None = None
    ) -> None:
        """Add a vote for an object above 0 to each of some different voxels [E], in known rows."""
        rows = self.rows(keys) if rows is None else rows
        known = rows >= 0
        self._vote(rows[known], objects[known])
        self._append(keys[~known], objects[~known])

    def _append(self, keys: Keys, objects: NDArray[np.int32]) -> None:
        self._index.append(keys)
        self._keys.append(keys)
        none = np.zeros_like(objects)
        self._owners.append(np.stack([objects, none], axis=1))
        self._votes.append(np.stack([none + 1, none], axis=1))

    def _vote(self, rows: NDArray[np.int32], objects: NDArray[np.int32]) -> None:
        owners, votes = self.owners[rows], self.votes[rows]
        first, second = owners[:, 0] == objects, owners[:, 1] == objects
        free = ~first & ~second & (votes[:, 1] <= 1)
        other = ~first & ~second & ~free
        votes[:, 0] += first
        votes[:, 1] += second
        votes[:, 1] -= other
        owners[free, 1], votes[free, 1] = objects[free], 1
        swap = votes[:, 1] > votes[:, 0]
        owners[swap], votes[swap] = owners[swap, ::-1], votes[swap, ::-1]
        full = votes[:, 0] > _MAX_VOTES
        votes[full] -= (votes[full] > 0).astype(np.int32)
        self.owners[rows], self.votes[rows] = owners, votes

    def rows(self, keys: Keys) -> NDArray[np.int32]:
        """The row [E] of each voxel, -1 where there is none."""
        return self._index.find(keys)

    def rows_of(self, seen: MaskedVoxels) -> NDArray[np.int32]:
        """The row [E] of each visible voxel, or of the next one along the ray within the noise."""
        rows = self.rows(seen.keys)
        rays = seen.points - seen.camera
        lengths = np.linalg.norm(rays, axis=1)
        shift = np.maximum(0.5 * self.voxel_m, 2.0 * seen.noise) / np.maximum(lengths, 1e-9)
        for sign in (1.0, -1.0):
            missing = np.flatnonzero(rows < 0)
            if not len(missing) or not len(self):
                break
            near = seen.points[missing] + sign * shift[missing, None] * rays[missing]
            rows[missing] = self.rows(voxel_keys(voxels_of(near, self.voxel_m)))
        return rows

    def relabel(self, objects: NDArray[np.int32]) -> None:
        """Replace the object of every vote by that of a table [M + 1], in which 0 stays 0."""
        owners = objects[self.owners]
        same = (owners[:, 0] == owners[:, 1]) & (owners[:, 0] > 0)
        self.votes[same] = np.stack([self.votes[same].sum(axis=1), np.zeros(same.sum(), int)], 1)
        owners[same, 1] = 0
        gone = owners == 0
        self.votes[gone] = 0
        first_gone = gone[:, 0] & ~gone[:, 1]
        owners[first_gone] = owners[first_gone, ::-1]
        self.votes[first_gone] = self.votes[first_gone, ::-1]
        self.owners[:] = owners

    def owner_at(self, points: Array) -> NDArray[np.int32]:
        """The object [N] with most votes in the voxels of points [N, 3], 0 for none."""
        rows = self.rows(voxel_keys(voxels_of(points, self.voxel_m)))
        return np.where(rows >= 0, self.owners[rows, 0] if len(self) else 0, 0).astype(np.int32)

    def state(self) -> dict[str, NDArray]:
        """Arrays that `restore` accepts."""
        return {"keys": self.keys, "owners": self.owners, "votes": self.votes}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        keys, owners = np.asarray(arrays["keys"]), np.asarray(arrays["owners"])
        restored = VoxelVotes(self.voxel_m)
        restored._append(keys, owners[:, 0])
        restored.owners[:], restored.votes[:] = owners, arrays["votes"]
        self.__dict__.update(restored.__dict__)
