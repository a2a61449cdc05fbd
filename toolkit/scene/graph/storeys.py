"""Storeys: levels of the floor, one above the other."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.thinning import thinned
from toolkit.base.geometry.voxels import voxel_keys, voxels_of
from toolkit.scene.graph.boxes import Ground

Array = NDArray[np.float64]
# Ceilings are structures.
StoreyKind = Literal["object", "floor", "structure"]

# Floors whose heights differ by less belong to one storey: steps, ramps and platforms.
MIN_STOREY_M = 1.8
_BIN_M = 0.1
# A level has at least this share of the largest level's points, and this many times the points of
# the heights around it: ramps and stairs have points at all heights.
_MIN_SHARE, _MIN_CONTRAST = 0.1, 3.0
# Objects stand up to this much below the height of their floor.
_BELOW_M = 0.4
# What ends so far below a floor is part of the storey below; points are up to this much lower.
_UNDER_M, _POINT_M = 0.1, 0.2
# Walls and other structures belong to each storey into which they reach so far.
_REACH_M = 1.0
# Points at most this far from the height of a level belong to its floor.
_FLOOR_M = 0.15
# A single floor has at least this share of its points at most this far from its plane.
_SINGLE_SHARE, _SINGLE_M = 0.9, 0.3
# Patches of floors whose normals are compared: their edge, the minimum number of points, and the
# maximum ratio of thickness to width; and the number of points that suffice.
_PATCH_M, _PATCH_POINTS, _PATCH_RATIO, _MAX_POINTS = 1.0, 8, 0.2, 20_000
# Minimum mean square cosine between normals of patches and the one that they share.
_MIN_AGREEMENT = 0.8
_FIT_ROUNDS = 3


@dataclass(frozen=True)
class Storeys:
    """Heights of storeys along the vertical in metres, ascending; at least one."""

    heights_m: Sequence[float]

    def __len__(self) -> int:
        """Number of storeys."""
        return len(self.heights_m)

    def of(self, bottom_m: float, top_m: float = np.inf) -> int:
        """Return the index of the storey of an object.

        Args:
            bottom_m: its lowest height.
            top_m: its highest height; by default, it does not hang at the ceiling below a floor.
        """
        storey = max(bisect_left(self.heights_m, bottom_m + _BELOW_M) - 1, 0)
        hangs = storey > 0 and top_m < self.heights_m[storey] - _UNDER_M
        return storey - 1 if hangs else storey

    def reached(self, bottom_m: float, top_m: float) -> range:
        """Return the indices of the storeys of a structure by its lowest and highest height."""
        first = self.of(bottom_m, top_m)
        last = bisect_left(self.heights_m, top_m - _REACH_M) - 1
        return range(first, max(first, last) + 1)

    def at(self, heights_m: Array) -> NDArray[np.intp]:
        """Return the index of the storey of points or cameras by their heights [N]."""
        return np.maximum(np.searchsorted(self.heights_m, heights_m + _POINT_M) - 1, 0)

    def headroom_m(self, storey: int) -> float:
        """Return the height of a storey up to the next floor, infinite for the highest one."""
        if storey + 1 == len(self):
            return np.inf
        return self.heights_m[storey + 1] - self.heights_m[storey] - _POINT_M


@dataclass(frozen=True)
class Floors:
    """The floors of a map.

    Attributes:
        ground: plane of the lowest storey.
        storeys: all storeys.
    """

    ground: Ground
    storeys: Storeys

    def of(self, storey: int) -> Ground:
        """Return the plane of the floor of a storey."""
        if len(self.storeys) == 1:
            return self.ground
        return Ground(self.ground.up, self.storeys.heights_m[storey])

    def at(self, points_m: Array) -> NDArray[np.intp]:
        """Return the index [N] of the storey of points or cameras [N, 3]."""
        if len(self.storeys) == 1:
            return np.zeros(len(points_m), np.intp)
        return self.storeys.at(points_m @ self.ground.up)

    def of_object(self, points_m: Array, kind: StoreyKind) -> range:
        """Return the indices of the storeys of an object [N, 3].

        Objects have one storey, structures all into which they reach, and floors all whose height
        they have: a ramp joins floors.
        """
        if len(self.storeys) == 1:
            return range(1)
        low, high = np.percentile(points_m @ self.ground.up, (2, 98)).tolist()
        if kind == "structure":
            return self.storeys.reached(low, high)
        if kind == "floor":
            return range(self.storeys.of(low), self.storeys.of(high) + 1)
        storey = self.storeys.of(low, high)
        return range(storey, storey + 1)


def find_storeys(floor_m: Array, default_m: float) -> Storeys:
    """Return the storeys of a map.

    Args:
        floor_m: [N] heights of points of floors.
        default_m: height of the only storey without such points.
    """
    if len(floor_m) == 0:
        return Storeys([default_m])
    bins = np.floor((floor_m - floor_m.min()) / _BIN_M).astype(int)
    counts = np.convolve(np.bincount(bins), np.ones(3), mode="same")
    found: list[int] = []
    for level in np.argsort(-counts, kind="stable").tolist():
        if counts[level] < _MIN_SHARE * counts.max():
            break
        apart = all(abs(level - other) * _BIN_M >= MIN_STOREY_M for other in found)
        if apart and (not found or _stands_out(counts, level)):
            found.append(level)
    heights_m = [float(np.median(floor_m[np.abs(bins - level) <= 1])) for level in sorted(found)]
    return Storeys(heights_m)


def _stands_out(counts: Array, level: int) -> bool:
    """Return whether a level is flat: most heights around it have few points."""
    reach = round(MIN_STOREY_M / _BIN_M / 2)
    around = np.pad(counts, reach)[level : level + 2 * reach + 1]
    return bool(counts[level] >= _MIN_CONTRAST * np.median(around))


def lowest_floor(floor_m: Array, others_m: Array) -> Ground | None:
    """Fit a plane to the floor of the lowest storey; up points towards the other points.

    Args:
        floor_m: [N, 3] points of floors.
        others_m: [M, 3] other points of the map, or positions of the camera.

    Returns:
        None if the points do not form planes.
    """
    plane = Ground.below(floor_m, others_m)
    if plane is not None:
        heights_m = floor_m @ plane.up
        near = np.abs(heights_m - plane.height_m) <= _SINGLE_M
        if near.mean() >= _SINGLE_SHARE and len(find_storeys(heights_m, 0.0)) == 1:
            return plane
    # A plane through the floors of several storeys is none of them.
    normal = _common_normal(floor_m)
    if normal is None:
        return plane
    for _ in range(_FIT_ROUNDS):
        storeys = find_storeys(floor_m @ normal, 0.0)
        if len(storeys) == 1:
            return plane
        normal = _normal_of_levels(floor_m, normal, storeys)
    up = _upwards(normal, floor_m, others_m)
    heights_m = floor_m @ up
    lowest_m = find_storeys(heights_m, 0.0).heights_m[0]
    near = np.abs(heights_m - lowest_m) <= _FLOOR_M
    return Ground(up, float(heights_m[near].mean()))


def _common_normal(points_m: Array) -> Array | None:
    """Return the normal [3] that the patches of floors [N, 3] share; None if they do not."""
    points = thinned(points_m, _MAX_POINTS)
    _, patch = np.unique(voxel_keys(voxels_of(points, _PATCH_M)), return_inverse=True)
    counts = np.bincount(patch)

    def summed(values: Array) -> Array:
        columns = values.reshape(len(values), -1).T
        return np.stack([np.bincount(patch, column) for column in columns], axis=1)

    offsets = points - (summed(points) / counts[:, None])[patch]
    scatter = summed(offsets[:, :, None] * offsets[:, None, :]).reshape(-1, 3, 3)
    variances, axes = np.linalg.eigh(scatter)
    thickness, width = np.sqrt(np.maximum(variances[:, :2], 0.0)).T
    flat = (counts >= _PATCH_POINTS) & (thickness <= _PATCH_RATIO * width)
    if not flat.any():
        return None
    normals = axes[flat][:, :, 0] * np.sqrt(counts[flat])[:, None]
    shares, directions = np.linalg.eigh(normals.T @ normals / counts[flat].sum())
    return np.asarray(directions[:, 2]) if shares[2] >= _MIN_AGREEMENT else None


def _normal_of_levels(points_m: Array, normal: Array, storeys: Storeys) -> Array:
    """Fit parallel planes to the points near each level; return their normal [3]."""
    heights_m = points_m @ normal
    scatter = np.zeros((3, 3))
    for height_m in storeys.heights_m:
        near = points_m[np.abs(heights_m - height_m) <= _FLOOR_M]
        offsets = near - near.mean(axis=0)
        scatter += offsets.T @ offsets
    return np.asarray(np.linalg.eigh(scatter)[1][:, 0])


def _upwards(normal: Array, floor_m: Array, others_m: Array) -> Array:
    """Return the normal or its opposite: nothing lies below the lowest floor."""
    levels_m = find_storeys(floor_m @ normal, 0.0).heights_m
    others = others_m @ normal
    ahead = float((others > levels_m[-1]).sum()) - float((others < levels_m[0]).sum())
    if ahead == 0.0:
        ahead = float(others.mean() - (floor_m @ normal).mean())
    return normal if ahead >= 0 else -normal
