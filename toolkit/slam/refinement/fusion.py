"""Fusion of all submaps into one map without duplicated surfaces.

Space is divided into voxels. If several submaps have a surface in a voxel, the submap that was
optimised most around it keeps its Gaussians and the others are removed. Gaussians are not averaged.
Voxels are compared instead of single Gaussians because two samplings of one surface rarely have
the same centres. An ellipsoid may be larger than a voxel, and counts for all that it covers.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.caching import LruCache
from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.voxels import voxel_keys, voxels_of
from toolkit.slam.mapping.depth_views import DepthView
from toolkit.slam.mapping.free_space import Evidence, is_measured
from toolkit.slam.refinement.exposures import at_typical_exposure, estimate_exposures
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import rotation_matrices

Array = NDArray[np.float64]

# Voxel size in metres: larger than registration errors, smaller than furniture.
VOXEL_M = 0.05
# Minimum mass in a voxel for a surface: the sum of opacities of spheres. Ellipsoids that cover the
# area of a voxel have `_COVERING` in total.
_MIN_MASS, _COVERING = 2.0, 4.0
# Side in voxels of the blocks whose steps decide where several submaps have a surface. If each
# voxel decided for itself, submaps would alternate, with gaps between their Gaussians: 0.15 dB in a
# walk with a HoloLens, 1.9 dB in a room that continues a finished map. Blocks of 8 are equal.
_BLOCK = 4
# Samples of an ellipsoid along each of its longer axes, in standard deviations: with these, they
# have its covariance.
_SAMPLES = math.sqrt(1.5) * np.array([-1.0, 0.0, 1.0])
# Size of the LRU cache of parts, in megabytes. Rebuilding a part reads its submap with all
# keyframes.
_CACHE_MB = 256.0
# Rendered extent of a Gaussian, in radii.
_REACH = 4.0
# Maximum number of keyframes of a submap whose free space is compared with other submaps, and of
# submaps whose views are in memory at a time; limit memory and time.
_MAX_VIEWS, _SUBMAPS_WITH_VIEWS = 128, 8


class FusedMap:
    """One map in the world frame; the part of each submap is built on demand.

    Args:
        submap: returns the submap of a number; must be deterministic.
        kept: [N] bool mask by submap, the Gaussians that are part of the map; None keeps all.
        exposures: exposure of each submap relative to the map, by number.
    """

    def __init__(
        self,
        submap: Callable[[int], Submap],
        kept: dict[int, Tensor | None],
        exposures: dict[int, Exposure],
    ) -> None:
        self.exposures = exposures
        self._submap, self._kept = submap, kept
        self._cache: OrderedDict[int, GaussianCloud] = OrderedDict()
        self._boxes: dict[int, tuple[Array, Array]] = {}
        self._sizes: dict[int, int] = {}

    def converted(self, convert: Callable[[Submap], Submap]) -> FusedMap:
        """The same map of converted submaps, whose Gaussians must be the same in order."""
        load = self._submap
        return FusedMap(lambda number: convert(load(number)), self._kept, self.exposures)

    @property
    def numbers(self) -> list[int]:
        """Ascending submap numbers."""
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
        """Gaussians kept from a submap, in the world frame and at the exposure of the map."""
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        submap, kept = self._submap(number), self._kept[number]
        cloud = submap.gaussians
        if kept is not None:
            cloud = cloud.select(kept).transformed(submap.T_world_submap)
        exposure = self.exposures[number]
        if exposure != IDENTITY:
            cloud = cloud.recoloured(exposure.apply)
        self._cache[number] = cloud
        while len(self._cache) > 1 and sum(map(_megabytes, self._cache.values())) > _CACHE_MB:
            self._cache.popitem(last=False)
        return cloud

    def parts(self) -> Iterator[GaussianCloud]:
        """Iterate over the parts of all submaps in ascending order."""
        return (self.part(number) for number in self.numbers)

    def visible_from(self, camera: Camera, T_map_camera: Array) -> GaussianCloud:
        """Concatenate the parts that may be visible in a view."""
        T_camera_map = se3.inverse(T_map_camera)
        seen = [n for n in self.numbers if _may_show(camera, T_camera_map, *self._box(n))]
        parts = [self.part(number) for number in seen or self.numbers[:1]]
        return parts[0] if len(parts) == 1 else GaussianCloud.concatenate(parts)

    def _box(self, number: int) -> tuple[Array, Array]:
        """Minimum and maximum corner [3] of a part, including the extent of its Gaussians."""
        if number not in self._boxes:
            cloud = self.part(number)
            means = cloud.means.double().numpy()
            longest = cloud.as_ellipsoids().log_scales.amax(dim=1).exp()
            reach = _REACH * longest.double().numpy()[:, None]
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
        """[N] int32 submap number of each Gaussian."""
        return torch.cat([torch.full((self._size(n),), n, dtype=torch.int32) for n in self.numbers])


def _megabytes(cloud: GaussianCloud) -> float:
    return 4e-6 * sum(tensor.numel() for tensor in cloud.tensors().values())


def _may_show(camera: Camera, T_camera_map: Array, low: Array, high: Array) -> bool:
    """Conservative test whether a box intersects the view frustum."""
    pick = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], bool)
    corners = se3.transform_points(T_camera_map, np.where(pick, high, low))
    x, y, z = corners.T
    # Extend the image by one pixel per side for the footprint of projected Gaussians.
    left, right = (-1.0 - camera.cx) / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = (-1.0 - camera.cy) / camera.fy, (camera.height - camera.cy) / camera.fy
    outside = (z <= 0, x < left * z, x > right * z, y < top * z, y > bottom * z)
    return not any(side.all() for side in outside)


def fuse(atlas: Atlas, part: Sequence[int], free_space: bool) -> FusedMap | None:
    """Fuse all readable submaps of a part of the map.

    Args:
        part: submap numbers with known relative poses.
        free_space: remove Gaussians from empty space.

    Returns:
        The map; None if no submap of the part is readable.
    """
    numbers = [number for number in part if number not in atlas.unreadable]
    if not numbers:
        return None
    if len(part) == 1:
        return single_submap(numbers[0], atlas.submap)
    return fuse_submaps(numbers, atlas.submap, VOXEL_M, free_space)


def single_submap(number: int, submap: Callable[[int], Submap]) -> FusedMap:
    """The map of one submap, in its frame and at the typical exposure of its keyframes."""
    keyframes = {number: _keyframe_exposures(submap(number))}
    return FusedMap(submap, {number: None}, at_typical_exposure({number: IDENTITY}, keyframes))


def fuse_submaps(
    numbers: Sequence[int],
    submap: Callable[[int], Submap],
    voxel_m: float = VOXEL_M,
    free_space: bool = True,
) -> FusedMap:
    """Fuse submaps placed by their `T_world_submap`, at the typical exposure of their keyframes.

    Args:
        numbers: submap numbers, at least one.
        submap: returns the submap of a number; must be deterministic. Submaps are loaded one at a
            time and must have the same number of feature channels.
        voxel_m: voxel size, metres.
        free_space: remove Gaussians that keyframes of all submaps measured through.
    """
    statistics: dict[int, _VoxelStatistics] = {}
    keyframes: dict[int, list[Exposure]] = {}
    for number in numbers:
        one = submap(number)
        statistics[number] = _voxel_statistics(one, voxel_m)
        keyframes[number] = _keyframe_exposures(one)
    exposures = estimate_exposures({n: (s.voxels, s.colour) for n, s in statistics.items()})
    owners = _owners(statistics)
    views = _FreeSpaceViews(numbers if free_space else (), submap)
    kept: dict[int, Tensor | None] = {}
    for number in numbers:
        index = np.searchsorted(owners.voxels, _voxels(submap(number), voxel_m))
        mask = torch.from_numpy(owners.submap[index] == number)
        kept[number] = mask & ~views.contradict(submap(number))
    return FusedMap(submap, kept, at_typical_exposure(exposures, keyframes))


def _keyframe_exposures(submap: Submap) -> list[Exposure]:
    return [keyframe.exposure for keyframe in submap.keyframes]


class _FreeSpaceViews:
    """What the keyframes of all submaps measured as empty.

    A submap is compared with the views that reach its Gaussians, so that the time does not grow
    with the square of the number of submaps, and the views of few submaps are in memory.
    """

    def __init__(self, numbers: Sequence[int], submap: Callable[[int], Submap]) -> None:
        self._submap = submap
        self._views: LruCache[list[DepthView]] = LruCache(_SUBMAPS_WITH_VIEWS)
        self._boxes = {n: [view.box for view in self._views_of(n)] for n in numbers}

    def contradict(self, submap: Submap) -> Tensor:
        """Mask [N] of the Gaussians of a submap in empty space."""
        cloud = submap.gaussians.transformed(submap.T_world_submap)
        if not self._boxes or not len(cloud):
            return torch.zeros(len(cloud), dtype=torch.bool)
        low, high = (corner.double().numpy() for corner in torch.aminmax(cloud.means, dim=0))
        evidence = Evidence.of(cloud.means, self._reaching(low, high))
        return evidence.contradicts_in_map(cloud.radii_m)

    def _reaching(self, low: Array, high: Array) -> Iterator[DepthView]:
        for number, boxes in self._boxes.items():
            reach = [bool((box[0] <= high).all() and (box[1] >= low).all()) for box in boxes]
            if any(reach):
                yield from compress(self._views_of(number), reach)

    def _views_of(self, number: int) -> list[DepthView]:
        """The depth that a submap's keyframes measured, in the world; at most `_MAX_VIEWS`."""
        return self._views.get(number, lambda: self._new_views(number))

    def _new_views(self, number: int) -> list[DepthView]:
        submap = self._submap(number)
        if not is_measured(submap.keyframes):
            return []
        keyframes = submap.keyframes[:: -(-len(submap.keyframes) // _MAX_VIEWS) or 1]
        return [DepthView.of(keyframe, submap.T_world_submap) for keyframe in keyframes]


@dataclass(frozen=True)
class _Owners:
    """Owner of each voxel.

    Attributes:
        voxels: [V] ascending int64 keys.
        submap: [V] number of the submap that owns the voxel.
    """

    voxels: NDArray[np.int64]
    submap: NDArray[np.int32]


@dataclass(frozen=True)
class _VoxelStatistics:
    """Voxel statistics of a submap in the world frame.

    Attributes:
        voxels: [V] ascending int64 keys.
        weight: [V] priority for ownership: voxels with a surface precede voxels with stray
            Gaussians, then the number of optimisation steps in the block decides.
        colour: [V, 3] mean colour, NaN without a surface.
    """

    voxels: NDArray[np.int64]
    weight: NDArray[np.float64]
    colour: NDArray[np.float64]


def _voxel_statistics(submap: Submap, voxel_m: float) -> _VoxelStatistics:
    cloud = submap.gaussians.transformed(submap.T_world_submap)
    points, mass = _samples(cloud, voxel_m)
    indices = voxels_of(points.reshape(-1, 3), voxel_m)
    voxels, first, inverse = np.unique(voxel_keys(indices), return_index=True, return_inverse=True)
    blocks = np.unique(voxel_keys(indices // _BLOCK), return_inverse=True)[1]

    def summed(values: Array, cells: NDArray[np.intp] = inverse) -> Array:
        weights = np.repeat(mass * values, points.shape[1])
        return np.bincount(cells, weights).astype(np.float64, copy=False)

    total = summed(np.ones(len(mass)))
    solid = total >= _MIN_MASS
    steps = summed(submap.optimiser.steps.double().numpy(), blocks)[blocks[first]]
    sums = [summed(channel) for channel in cloud.colours.double().numpy().T]
    mean = np.stack(sums, axis=1) / np.maximum(total, 1e-9)[:, None]
    mean[~solid] = np.nan
    return _VoxelStatistics(voxels, np.where(solid, 1e12, 0.0) + steps, mean)


def _samples(cloud: GaussianCloud, voxel_m: float) -> tuple[Array, Array]:
    """Points [N, S, 3] of the surface of each Gaussian, and the mass [N] of each of them."""
    means, opacity = cloud.means.double().numpy()[:, None], cloud.opacities.double().numpy()
    shapes = cloud.ellipsoids
    if shapes is None:
        return means, opacity
    axes = rotation_matrices(shapes.rotations).double().numpy().swapaxes(1, 2)
    scales_m = shapes.log_scales.double().exp().numpy()
    longer = np.argsort(-scales_m, axis=1, kind="stable")[:, :2]
    sides_m = np.take_along_axis(scales_m, longer, axis=1)
    sides = np.take_along_axis(axes, longer[:, :, None], axis=1) * sides_m[:, :, None]
    u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(_SAMPLES, _SAMPLES))
    points = means + u * sides[:, None, 0] + v * sides[:, None, 1]
    area = 2.0 * math.pi * sides_m.prod(axis=1) / voxel_m**2
    return points, _COVERING * area * opacity / points.shape[1]


def _owners(seen: dict[int, _VoxelStatistics]) -> _Owners:
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
    """Key [N] of the world voxel that contains each Gaussian."""
    means = submap.gaussians.transformed(submap.T_world_submap).means.double().numpy()
    return voxel_keys(voxels_of(means, voxel_m))
