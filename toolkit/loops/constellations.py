"""Constellations of objects: a relative pose of two submaps from the classes and places of objects.

Light, colours and textures do not matter, and objects that have moved are outliers. Pairs of
objects of one class and similar size are the nodes of a graph, and two pairs are connected if the
distances between their objects agree in both submaps. The largest clique gives the pose. It is a
candidate only: identical rooms have identical constellations.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from toolkit.geometry import se3
from toolkit.loops.pose_graph.clique import largest_clique

Array = NDArray[np.float64]

# Edge of the voxels whose connected components are objects. Neighbours touch at a corner at least.
_VOXEL_M = 0.06
_AROUND = itertools.product((-1, 0, 1), repeat=3)
_NEIGHBOURS = np.array([step for step in _AROUND if step > (0, 0, 0)])
# Minimum number of voxels of an object, and maximum number of a class in total: classes with more
# are parts of the building.
_MIN_VOXELS, _MAX_VOXELS = 8, 1500
# Of more points, every n-th is used.
_MAX_POINTS = 40_000
# Objects beyond this size are seen in parts, whose centres differ.
_MAX_SIZE_M = 1.8
# Maximum ratio of the sizes of objects that may be the same, in logarithms.
_MAX_LOG_SIZE = 0.6
# Error of a centre: constant, and as a fraction of the size, because views show different sides.
_CENTRE_M, _CENTRE_FRACTION = 0.05, 0.1
# Largest number of assignments in the graph, and of objects of one class in a submap: of many equal
# objects, none is distinctive.
_MAX_ASSIGNMENTS, _MAX_EQUAL = 40, 6
# Minimum number of objects that agree, and minimum spread of their centres in two directions.
_MIN_OBJECTS, _MIN_SPREAD_M = 4, 0.25


@dataclass(frozen=True)
class Constellation:
    """The objects of a submap.

    Attributes:
        class_ids: [K] class of each object.
        centres_m: [K, 3] centre in the frame of the submap, metres.
        sizes_m: [K] diagonal of a box of the same spread, metres.
    """

    class_ids: NDArray[np.int64]
    centres_m: Array
    sizes_m: Array

    def __len__(self) -> int:
        return len(self.class_ids)

    @classmethod
    def of(cls, points_m: Array, class_ids: NDArray[np.integer]) -> Constellation:
        """Build the constellation of points: the connected components of each class.

        Args:
            points_m: [N, 3] points on surfaces, metres.
            class_ids: [N] class of each, 0 void.
        """
        step = max(1, len(points_m) // _MAX_POINTS)
        points_m, class_ids = points_m[::step], class_ids[::step]
        grid = _ClassVoxels.of(points_m[class_ids > 0], class_ids[class_ids > 0])
        numbers = grid.components()
        sizes = np.bincount(numbers)
        sums_m = [np.bincount(numbers, axis) for axis in grid.centres_m.T]
        means_m: Array = np.stack(sums_m, axis=1) / np.maximum(sizes, 1)[:, None]
        squares = ((grid.centres_m - means_m[numbers]) ** 2).sum(axis=1)
        # Equals the diagonal of a solid box; bounding boxes depend on the frame of the submap.
        sizes_m = np.sqrt(12.0 * np.bincount(numbers, squares) / np.maximum(sizes, 1))
        class_of = np.zeros(len(sizes), np.int64)
        class_of[numbers] = grid.class_ids
        kept = (sizes >= _MIN_VOXELS) & (sizes_m <= _MAX_SIZE_M)
        return cls(class_of[kept], means_m[kept], sizes_m[kept])


@dataclass(frozen=True)
class ConstellationMatch:
    """A relative pose of two constellations.

    Attributes:
        T_first_second: [4, 4].
        pairs: [K, 2] the objects that agree with it.
        error_m: root mean square of the distances of their centres.
    """

    T_first_second: Array
    pairs: NDArray[np.int64]
    error_m: float


def match_constellations(first: Constellation, second: Constellation) -> ConstellationMatch | None:
    """Return the pose of the second constellation in the first with the most agreeing objects.

    None if fewer than four objects agree, or if they lie on a line.
    """
    pairs = _assignments(first, second)
    if len(pairs) < _MIN_OBJECTS:
        return None
    a, b = first.centres_m[pairs[:, 0]], second.centres_m[pairs[:, 1]]
    sigma_m = _sigma_m(first, second, pairs)
    lengths = [np.linalg.norm(c[:, None] - c[None], axis=2) for c in (a, b)]
    agree = np.abs(lengths[0] - lengths[1]) < 2.0 * np.hypot(sigma_m[:, None], sigma_m[None])
    # Every object has one partner.
    agree &= (pairs[:, None] != pairs[None]).all(axis=2)
    clique = np.array(largest_clique(agree))
    return _fitted(first, second, pairs, clique)


def _fitted(
    first: Constellation, second: Constellation, pairs: NDArray[np.int64], chosen: NDArray
) -> ConstellationMatch | None:
    """Fit the pose to the chosen assignments, without those that disagree, as mirrored ones do."""
    for _ in range(len(pairs)):
        if len(chosen) < _MIN_OBJECTS:
            return None
        kept = pairs[chosen]
        a, b = first.centres_m[kept[:, 0]], second.centres_m[kept[:, 1]]
        sigma_m = _sigma_m(first, second, kept)
        T = _weighted_fit(a, b, 1.0 / sigma_m**2)
        errors_m = np.linalg.norm(a - b @ T[:3, :3].T - T[:3, 3], axis=1)
        worst = int(np.argmax(errors_m / sigma_m))
        if errors_m[worst] <= 2.0 * sigma_m[worst]:
            spread_m = np.linalg.svd(a - a.mean(axis=0), compute_uv=False) / np.sqrt(len(a))
            if spread_m[1] < _MIN_SPREAD_M:
                return None
            return ConstellationMatch(T, kept, float(np.sqrt((errors_m**2).mean())))
        chosen = np.delete(chosen, worst)
    return None


def _assignments(first: Constellation, second: Constellation) -> NDArray[np.int64]:
    """The pairs [L, 2] of objects that may be the same, those of rare classes first."""
    same = first.class_ids[:, None] == second.class_ids[None]
    ratio = np.abs(np.log(first.sizes_m[:, None] / second.sizes_m[None]))
    i, j = np.nonzero(same & (ratio < _MAX_LOG_SIZE))
    equal = np.maximum(same.sum(axis=1)[i], same.sum(axis=0)[j])
    i, j, equal = (values[equal <= _MAX_EQUAL] for values in (i, j, equal))
    order = np.lexsort((j, i, ratio[i, j].round(6), equal))[:_MAX_ASSIGNMENTS]
    return np.stack([i[order], j[order]], axis=1)


def _sigma_m(first: Constellation, second: Constellation, pairs: NDArray[np.int64]) -> Array:
    """Error [L] of the distance between the centres of pairs of objects."""
    size_m = np.maximum(first.sizes_m[pairs[:, 0]], second.sizes_m[pairs[:, 1]])
    return _CENTRE_M + _CENTRE_FRACTION * size_m


def _weighted_fit(a: Array, b: Array, weights: Array) -> Array:
    """The rigid motion [4, 4] that maps points b [K, 3] to a [K, 3] (Kabsch 1976)."""
    weights = weights / weights.sum()
    mean_a, mean_b = weights @ a, weights @ b
    u, _, vt = np.linalg.svd((a - mean_a).T @ (weights[:, None] * (b - mean_b)))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, mean_a - R @ mean_b
    return T


@dataclass(frozen=True)
class _ClassVoxels:
    """Occupied voxels of the classes that are objects and not parts of the building.

    Attributes:
        keys: [V] ascending; neighbours differ by a constant for each direction.
        steps: [13] these constants.
        centres_m: [V, 3].
        class_ids: [V].
    """

    keys: NDArray[np.int64]
    steps: NDArray[np.int64]
    centres_m: Array
    class_ids: NDArray[np.int64]

    @classmethod
    def of(cls, points_m: Array, class_ids: NDArray[np.integer]) -> _ClassVoxels:
        """Find the voxels of points [N, 3] of classes [N]."""
        voxels = np.floor(points_m / _VOXEL_M).astype(np.int64)
        low = voxels.min(axis=0, initial=0)
        # One empty layer on each side, so that the neighbours of the last row are not in the next.
        shape = voxels.max(axis=0, initial=0) - low + 3
        strides = np.array([shape[1] * shape[2], shape[2], 1])
        volume = int(shape.prod())
        keys = np.unique(class_ids.astype(np.int64) * volume + (voxels - low + 1) @ strides)
        kept = np.bincount(keys // volume)[keys // volume] <= _MAX_VOXELS
        keys = keys[kept]
        places = np.stack(np.unravel_index(keys % volume, shape), axis=1) + low - 1
        return cls(keys, _NEIGHBOURS @ strides, (places + 0.5) * _VOXEL_M, keys // volume)

    def components(self) -> NDArray[np.intp]:
        """The number [V] of the connected component of each voxel."""
        if not len(self.keys):
            return np.zeros(0, np.intp)
        beside = self.keys[:, None] + self.steps
        found = np.searchsorted(self.keys, beside).clip(max=len(self.keys) - 1)
        start, side = np.nonzero(self.keys[found] == beside)
        links = (np.ones(len(start), bool), (start, found[start, side]))
        graph = coo_matrix(links, (len(self.keys),) * 2)
        return np.asarray(connected_components(graph, directed=False)[1], np.intp)


def closest_view(
    T_map_camera: Array, others: Sequence[Array], max_m: float, max_rad: float
) -> int | None:
    """Index of the camera pose that is most similar to another one; None without a similar one.

    A radian counts as a metre.

    Args:
        T_map_camera: [4, 4].
        others: K poses [4, 4].
        max_m, max_rad: maximum distance and angle.
    """
    poses = np.array(others)
    metres = np.linalg.norm(poses[:, :3, 3] - T_map_camera[:3, 3], axis=1)
    radians = se3.rotation_angle_rad(poses[:, :3, :3].transpose(0, 2, 1) @ T_map_camera[:3, :3])
    apart = np.where((metres <= max_m) & (radians <= max_rad), metres + radians, np.inf)
    nearest = int(np.argmin(apart))
    return nearest if np.isfinite(apart[nearest]) else None
