"""All submaps as one map, with what overlaps told once.

Space is cut into voxels. Where several submaps have a surface in one voxel, it belongs to the
one that was optimised most there, and the others give up their Gaussians in it: a wall seen by
two submaps stays one wall, and nothing is averaged away. Voxels, and not single Gaussians,
since two samplings of one surface hardly ever have their centres in the same places.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.exposure import IDENTITY, Exposure
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.refinement.exposures import agreed_exposures
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]

# Voxel edge in metres: well above what registration leaves, well below furniture.
VOXEL_M = 0.05
# A submap shows a surface in a voxel where its Gaussians' opacities sum to so much.
_LEAST_OPACITY = 2.0
# Parts of the map are kept in memory up to so many megabytes, those that views asked for last:
# to make one again, its submap is read with all its keyframes.
_HELD_MB = 256.0
# Beyond so many radii a Gaussian is nowhere drawn.
_REACH = 4.0


class FusedMap:
    """One map in the world's frame; its parts are made from their submaps when asked for.

    Args:
        submap: gives a submap by its number, always the same.
        kept: [N] bool for each submap, which of its Gaussians are part of the map; None for all.
        exposures: of each submap against the whole map, by number.
    """

    def __init__(
        self,
        submap: Callable[[int], Submap],
        kept: dict[int, Tensor | None],
        exposures: dict[int, Exposure],
    ) -> None:
        self.exposures = exposures
        self._submap, self._kept = submap, kept
        self._held: OrderedDict[int, GaussianCloud] = OrderedDict()
        self._boxes: dict[int, tuple[Array, Array]] = {}
        self._sizes: dict[int, int] = {}

    @property
    def numbers(self) -> list[int]:
        """Of its submaps, in order."""
        return sorted(self._kept)

    def __len__(self) -> int:
        return sum(self._size(number) for number in self.numbers)

    def _size(self, number: int) -> int:
        kept = self._kept[number]
        if kept is not None:
            return int(kept.sum())
        if number not in self._sizes:
            self._sizes[number] = len(self._submap(number).gaussians)
        return self._sizes[number]

    def part(self, number: int) -> GaussianCloud:
        """What a submap gives to the map, in the world's frame and at its exposure."""
        if number in self._held:
            self._held.move_to_end(number)
            return self._held[number]
        submap, kept = self._submap(number), self._kept[number]
        cloud = submap.gaussians
        if kept is not None:
            cloud = cloud.select(kept).transformed(submap.T_world_submap)
            cloud = replace(cloud, colours=self.exposures[number].apply(cloud.colours))
        self._held[number] = cloud
        while len(self._held) > 1 and sum(map(_megabytes, self._held.values())) > _HELD_MB:
            self._held.popitem(last=False)
        return cloud

    def parts(self) -> Iterator[GaussianCloud]:
        """What each submap gives, by their numbers."""
        return (self.part(number) for number in self.numbers)

    def seen_from(self, camera: Camera, T_map_camera: Array) -> GaussianCloud:
        """The parts that reach into a view."""
        T_camera_map = se3.inverse(T_map_camera)
        seen = [n for n in self.numbers if _may_show(camera, T_camera_map, *self._box(n))]
        parts = [self.part(number) for number in seen or self.numbers[:1]]
        return parts[0] if len(parts) == 1 else GaussianCloud.concatenate(parts)

    def _box(self, number: int) -> tuple[Array, Array]:
        """Lowest and highest corner [3] of a part, with the reach of its Gaussians."""
        if number not in self._boxes:
            cloud = self.part(number)
            means = cloud.means.double().numpy()
            reach = _REACH * cloud.radii_m.double().numpy()[:, None]
            empty = np.zeros((1, 3))
            low = (means - reach).min(axis=0) if len(means) else empty[0]
            high = (means + reach).max(axis=0) if len(means) else empty[0]
            self._boxes[number] = (low, high)
        return self._boxes[number]

    @property
    def gaussians(self) -> GaussianCloud:
        """The whole map in memory."""
        parts = list(self.parts())
        return parts[0] if len(parts) == 1 else GaussianCloud.concatenate(parts)

    @property
    def submap(self) -> Tensor:
        """[N] int32, where each Gaussian came from."""
        return torch.cat([torch.full((self._size(n),), n, dtype=torch.int32) for n in self.numbers])


def _megabytes(cloud: GaussianCloud) -> float:
    return 4e-6 * len(cloud) * (8 + cloud.features.shape[1])


def _may_show(camera: Camera, T_camera_map: Array, low: Array, high: Array) -> bool:
    """Whether a view can show anything of a box; True where that is not certain."""
    pick = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], bool)
    corners = se3.transform_points(T_camera_map, np.where(pick, high, low))
    x, y, z = corners.T
    # A pixel at least beyond each border, where blurred edges still reach.
    left, right = (-1.0 - camera.cx) / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = (-1.0 - camera.cy) / camera.fy, (camera.height - camera.cy) / camera.fy
    outside = (z <= 0, x < left * z, x > right * z, y < top * z, y > bottom * z)
    return not any(side.all() for side in outside)


def fuse(atlas: Atlas, voxel_m: float = VOXEL_M) -> FusedMap:
    """Join the submaps that can be read. A single one passes unchanged."""
    if len(atlas) == 1:
        return FusedMap(atlas.submap, {0: None}, {0: IDENTITY})
    return fuse_submaps(atlas.readable(), atlas.submap, voxel_m)


def fuse_submaps(
    numbers: Sequence[int], submap: Callable[[int], Submap], voxel_m: float = VOXEL_M
) -> FusedMap:
    """Join any submaps, each placed by its `T_world_submap`; the first one's exposure stays.

    Args:
        numbers: of the submaps, at least one. submap: gives them, always the same, so that they
            need not all be in memory; with equal feature channels.
    """
    seen = {number: _seen(submap(number), voxel_m) for number in numbers}
    owners = _owners(seen)
    exposures = agreed_exposures({n: (s.voxels, s.colour) for n, s in seen.items()})
    kept: dict[int, Tensor | None] = {}
    for number in numbers:
        place = np.searchsorted(owners.voxels, _voxels(submap(number), voxel_m))
        kept[number] = torch.from_numpy(owners.submap[place] == number)
    return FusedMap(submap, kept, exposures)


@dataclass(frozen=True)
class _Owners:
    """voxels: [V] int64 keys, ascending. submap: [V] the number of each one's owner."""

    voxels: NDArray[np.int64]
    submap: NDArray[np.int32]


@dataclass(frozen=True)
class _Seen:
    """What a submap has in each voxel of the world.

    Attributes:
        voxels: [V] int64 keys, ascending.
        weight: [V]; a submap with a surface there goes before one with a stray Gaussian, then
            the number of optimisation steps decides: how often and long the place was seen.
        colour: [V, 3] mean colour, nan where there is no surface.
    """

    voxels: NDArray[np.int64]
    weight: NDArray[np.float64]
    colour: NDArray[np.float64]


def _seen(submap: Submap, voxel_m: float) -> _Seen:
    voxels, inverse = np.unique(_voxels(submap, voxel_m), return_inverse=True)
    opacity = submap.gaussians.opacities.double().numpy()
    total = np.bincount(inverse, opacity)
    solid = total >= _LEAST_OPACITY
    steps = np.bincount(inverse, opacity * submap.steps.double().numpy())
    colours = submap.gaussians.colours.double().numpy()
    sums = [np.bincount(inverse, opacity * channel) for channel in colours.T]
    mean = np.stack(sums, axis=1) / np.maximum(total, 1e-9)[:, None]
    mean[~solid] = np.nan
    return _Seen(voxels, np.where(solid, 1e12, 0.0) + steps, mean)


def _owners(seen: dict[int, _Seen]) -> _Owners:
    key: NDArray[np.int64] = np.concatenate([s.voxels for s in seen.values()])
    weight: NDArray[np.float64] = np.concatenate([s.weight for s in seen.values()])
    number: NDArray[np.int32] = np.concatenate(
        [np.full(len(s.voxels), n, np.int32) for n, s in seen.items()]
    )
    order = np.lexsort((number, -weight, key))
    key, number = key[order], number[order]
    first = np.ones(len(key), bool)
    first[1:] = key[1:] != key[:-1]
    return _Owners(key[first], number[first])


def _voxels(submap: Submap, voxel_m: float) -> NDArray[np.int64]:
    """A key [N] for the voxel of the world that each Gaussian lies in."""
    means = submap.gaussians.transformed(submap.T_world_submap).means.double().numpy()
    cell = np.floor(means / voxel_m).astype(np.int64) + (1 << 20)
    return (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
