"""All submaps as one map, with what overlaps told once.

Space is cut into voxels. Where several submaps have a surface in one voxel, it belongs to the
one that was optimised most there, and the others give up their Gaussians in it: a wall seen by
two submaps stays one wall, and nothing is averaged away. Voxels, and not single Gaussians,
since two samplings of one surface hardly ever have their centres in the same places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.refinement.exposures import agreed_exposures
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.submap import Submap

# Voxel edge in metres: well above what registration leaves, well below furniture.
VOXEL_M = 0.05
# A submap shows a surface in a voxel where its Gaussians' opacities sum to so much.
_LEAST_OPACITY = 2.0


@dataclass(frozen=True)
class FusedMap:
    """One map in the world's frame.

    Attributes:
        gaussians: N Gaussians. submap: [N] int32, where each came from.
        exposures: gain and bias of each submap by number, world = gain * submap + bias.
    """

    gaussians: GaussianCloud
    submap: Tensor
    exposures: dict[int, tuple[float, float]]


def fuse(atlas: Atlas, voxel_m: float = VOXEL_M) -> FusedMap:
    """Join the submaps that can be read. A single one passes unchanged."""
    if len(atlas) == 1:
        cloud = atlas.mapper.content.gaussians
        return FusedMap(cloud, torch.zeros(len(cloud), dtype=torch.int32), {0: (1.0, 0.0)})
    return fuse_submaps(lambda: _readable(atlas), voxel_m)


def fuse_submaps(submaps: Callable[[], Iterable[Submap]], voxel_m: float = VOXEL_M) -> FusedMap:
    """Join any submaps, each placed by its `T_world_submap`; the first one's exposure stays.

    Args:
        submaps: gives them one after another, twice the same, so that they need not all be in
            memory; at least one, of different numbers and equal feature channels.
    """
    seen = {submap.number: _seen(submap, voxel_m) for submap in submaps()}
    owners = _owners(seen)
    exposures = agreed_exposures({n: (s.voxels, s.colour) for n, s in seen.items()})
    clouds, origin = [], []
    for submap in submaps():
        voxels = _voxels(submap, voxel_m)
        place = np.searchsorted(owners.voxels, voxels)
        kept = torch.from_numpy(owners.submap[place] == submap.number)
        cloud = submap.gaussians.select(kept).transformed(submap.T_world_submap)
        gain, bias = exposures[submap.number]
        cloud = replace(cloud, colours=cloud.colours * gain + bias)
        clouds.append(cloud)
        origin.append(torch.full((len(cloud),), submap.number, dtype=torch.int32))
    return FusedMap(GaussianCloud.concatenate(clouds), torch.cat(origin), exposures)


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


def _readable(atlas: Atlas) -> Iterator[Submap]:
    for number in atlas.readable():
        yield atlas.submap(number)


def _voxels(submap: Submap, voxel_m: float) -> NDArray[np.int64]:
    """A key [N] for the voxel of the world that each Gaussian lies in."""
    means = submap.gaussians.transformed(submap.T_world_submap).means.double().numpy()
    cell = np.floor(means / voxel_m).astype(np.int64) + (1 << 20)
    return (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
