"""Voxels that the masks of a keyframe cover, and votes of keyframes for the objects in voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.geometry.voxels import voxel_keys, voxels_of

Array = NDArray[np.float64]
Keys = NDArray[np.int64]

# Masks are compared on every n-th pixel in each direction, so that about this width remains.
SAMPLED_WIDTH = 160
# Limit of a voxel's votes for an object, so that later evidence can outvote an error.
_MAX_VOTES = 8
# Depth noise of an RGB-D camera in metres: offset, factor of the squared distance, and the
# distance where it is smallest (Nguyen, Izadi and Lovell, 2012).
_NOISE_M, _NOISE_PER_M, _NOISE_FROM_M = 0.0012, 0.0019, 0.4


def sampling_step(width: int) -> int:
    """Distance between the sampled pixels of an image of a width."""
    return max(1, round(width / SAMPLED_WIDTH))


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


def _changes(values: NDArray) -> NDArray[np.bool_]:
    """Mask of the places of sorted values where a new value starts."""
    changed = np.ones(len(values), bool)
    changed[1:] = values[1:] != values[:-1]
    return changed


def _merged(old: NDArray[np.bool_], before: NDArray, added: NDArray) -> NDArray:
    """Rows `before` where `old` holds, and `added` elsewhere."""
    merged = np.empty((len(old), *before.shape[1:]), before.dtype)
    merged[old], merged[~old] = before, added
    return merged


class VoxelVotes:
    """Votes of keyframes for the objects in voxels: the two objects with most votes per voxel.

    The counts are those of Misra and Gries (1982): a vote for a third object lowers the count of
    the second one. Memory therefore does not depend on the number of objects and keyframes.

    Attributes:
        keys: [V] ascending numbers of voxels.
        owners: [V, 2] int32 objects, 0 for none; the first has most votes.
        votes: [V, 2] int32 their votes.
    """

    def __init__(self, voxel_m: float) -> None:
        self.voxel_m = voxel_m
        self.keys: Keys = np.zeros(0, np.int64)
        self.owners = np.zeros((0, 2), np.int32)
        self.votes = np.zeros((0, 2), np.int32)

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self.keys)

    def add(self, keys: Keys, objects: NDArray[np.int32]) -> None:
        """Add a vote for an object above 0 to each of some ascending voxels [E]."""
        place = np.searchsorted(self.keys, keys)
        known = self._known(keys, place)
        self._vote(place[known], objects[known])
        new = ~known
        if not new.any():
            return
        added = np.zeros((int(new.sum()), 2), np.int32)
        first = np.zeros_like(added)
        added[:, 0], first[:, 0] = objects[new], 1
        rows = place[new] + np.arange(len(added))
        old = np.ones(len(self) + len(added), bool)
        old[rows] = False
        self.keys = _merged(old, self.keys, keys[new])
        self.owners = _merged(old, self.owners, added)
        self.votes = _merged(old, self.votes, first)

    def _vote(self, rows: NDArray[np.intp], objects: NDArray[np.int32]) -> None:
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

    def _known(self, keys: Keys, place: NDArray[np.intp]) -> NDArray[np.bool_]:
        if not len(self.keys):
            return np.zeros(len(keys), bool)
        return np.asarray(self.keys[np.minimum(place, len(self.keys) - 1)] == keys)

    def rows(self, keys: Keys) -> NDArray[np.intp]:
        """The row [E] of each voxel, -1 where there is none."""
        place = np.searchsorted(self.keys, keys)
        return np.where(self._known(keys, place), place, -1)

    def rows_of(self, seen: MaskedVoxels) -> NDArray[np.intp]:
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
        self.owners = owners

    def owner_at(self, points: Array) -> NDArray[np.int32]:
        """The object [N] with most votes in the voxels of points [N, 3], 0 for none."""
        rows = self.rows(voxel_keys(voxels_of(points, self.voxel_m)))
        return np.where(rows >= 0, self.owners[rows, 0] if len(self) else 0, 0).astype(np.int32)

    def state(self) -> dict[str, NDArray]:
        """Arrays that `restore` accepts."""
        return {"keys": self.keys, "owners": self.owners, "votes": self.votes}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self.keys = np.array(arrays["keys"])
        self.owners = np.array(arrays["owners"])
        self.votes = np.array(arrays["votes"])
