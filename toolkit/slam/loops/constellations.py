"""Constellations of objects: a relative pose of two submaps from the classes and places of objects.

Light, colours and textures do not matter, and objects that have moved are outliers. Objects are
connected components of classes, or instances. Pairs of objects of one class and similar size are
the nodes of a graph, and two pairs are connected if the distances between their objects agree in
both submaps. The largest clique gives the pose. It is a candidate only: identical rooms have
identical constellations.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.clique import largest_clique

Array = NDArray[np.float64]

# Edge of the voxels of objects. Neighbours in a connected component touch at a corner at least.
_VOXEL_M = 0.06
_AROUND = itertools.product((-1, 0, 1), repeat=3)
_NEIGHBOURS = np.array([step for step in _AROUND if step > (0, 0, 0)])
# Minimum number of voxels of an object, and maximum number of an instance or of a class in total:
# those with more are parts of the building.
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
        class_ids: [K] class of each object, 0 for an object that only its embedding describes.
        centres_m: [K, 3] centre in the frame of the submap, metres.
        sizes_m: [K] diagonal of a box of the same spread, metres.
        embeddings: [K, D] of unit length, 0 where unknown; D is 0 without embeddings.
    """

    class_ids: NDArray[np.int64]
    centres_m: Array
    sizes_m: Array
    embeddings: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.class_ids)

    @classmethod
    def of(
        cls,
        points_m: Array,
        class_ids: NDArray[np.integer],
        instance_ids: NDArray[np.integer] | None = None,
        embeddings: Mapping[int, NDArray[np.floating]] | None = None,
    ) -> Constellation:
        """Build the constellation of points.

        Every instance is an object. Of classes of which most points have no instance, the connected
        components of these points are objects as well.

        Args:
            points_m: [N, 3] points on surfaces, metres.
            class_ids: [N] class of each, 0 void.
            instance_ids: [N] instance of each, 0 for none; None if all have none.
            embeddings: [D] of unit length, by instance.
        """
        step = max(1, len(points_m) // _MAX_POINTS)
        points_m, labels = points_m[::step], np.asarray(class_ids[::step], np.int64)
        owners, classes = labels, int(labels.max(initial=0)) + 1
        if instance_ids is not None:
            owners = _with_instances(labels, instance_ids[::step].astype(np.int64), classes)
        voxels = _OwnedVoxels.of(points_m[owners > 0], owners[owners > 0])
        is_instance = voxels.owners > classes
        numbers = np.where(is_instance, -voxels.owners, voxels.components())
        _, places, numbers = np.unique(numbers, return_index=True, return_inverse=True)
        owner_of = voxels.owners[places]
        sizes = np.bincount(numbers)
        sums_m = [np.bincount(numbers, axis) for axis in voxels.centres_m.T]
        means_m: Array = np.stack(sums_m, axis=1) / np.maximum(sizes, 1)[:, None]
        squares = ((voxels.centres_m - means_m[numbers]) ** 2).sum(axis=1)
        # Equals the diagonal of a solid box; bounding boxes depend on the frame of the submap.
        sizes_m = np.sqrt(12.0 * np.bincount(numbers, squares) / np.maximum(sizes, 1))
        class_of = _most_frequent(owners, labels, owner_of)
        vectors = _rows_of(embeddings or {}, owner_of - classes)
        kept = (sizes >= _MIN_VOXELS) & (sizes_m <= _MAX_SIZE_M)
        kept &= (class_of > 0) | vectors.any(axis=1)
        return cls(class_of[kept], means_m[kept], sizes_m[kept], vectors[kept])


def _with_instances(
    class_ids: NDArray[np.int64], instance_ids: NDArray[np.int64], classes: int
) -> NDArray[np.int64]:
    """Owners [N] of points: the instance plus the number of classes, or the class, or 0 for none.

    What masks leave out of objects at their borders is none.
    """
    owned = instance_ids > 0
    points, inside = (np.bincount(ids, minlength=classes) for ids in (class_ids, class_ids[owned]))
    rest = np.where((2 * inside < points)[class_ids], class_ids, 0)
    return np.where(owned, instance_ids + classes, rest)


def _most_frequent(
    owners: NDArray[np.int64], class_ids: NDArray[np.int64], chosen: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The class [K] of most labelled points of each of the chosen owners, 0 without any."""
    classes = int(class_ids.max(initial=0)) + 1
    cells, counts = np.unique((owners * classes + class_ids)[class_ids > 0], return_counts=True)
    owner, class_id = np.divmod(cells[np.argsort(counts, kind="stable")], classes)
    table = np.zeros(int(owners.max(initial=0)) + 1, np.int64)
    table[owner] = class_id  # of several values, the last one remains
    return table[chosen]


def _rows_of(
    embeddings: Mapping[int, NDArray[np.floating]], instances: NDArray[np.int64]
) -> NDArray[np.float32]:
    """The embeddings [K, D] of instances, 0 where unknown."""
    length = max((len(vector) for vector in embeddings.values()), default=0)
    rows = [embeddings.get(int(number), np.zeros(length)) for number in instances]
    return np.array(rows, np.float32).reshape(len(instances), length)


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
    """The pairs [L, 2] of objects that may be the same, the most distinctive ones first.

    Objects of one class may be the same, and those with embeddings if a class is unknown. A pair is
    distinctive if few other objects are as similar to either of its two.
    """
    similarities, known = _similarities(first.embeddings, second.embeddings)
    same = first.class_ids[:, None] == second.class_ids[None]
    same = np.where(np.minimum.outer(first.class_ids, second.class_ids) > 0, same, known)
    ratio = np.abs(np.log(first.sizes_m[:, None] / second.sizes_m[None]))
    i, j = np.nonzero(same & (ratio < _MAX_LOG_SIZE))
    own = similarities[i, j]
    beside = (same[i] & (similarities[i] >= own[:, None])).sum(axis=1)
    others = (same[:, j] & (similarities[:, j] >= own)).sum(axis=0)
    equal = np.maximum(beside, others)
    i, j, own, equal = (values[equal <= _MAX_EQUAL] for values in (i, j, own, equal))
    order = np.lexsort((j, i, ratio[i, j].round(6), -own.round(6), equal))[:_MAX_ASSIGNMENTS]
    return np.stack([i[order], j[order]], axis=1)


def _similarities(
    first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[Array, NDArray[np.bool_]]:
    """Cosines [K, L] of embeddings minus their mean, 0 where one is unknown; where both are known.

    Encoders differ in the similarity of unrelated images, which the mean removes.
    """
    known = np.logical_and.outer(first.any(axis=1), second.any(axis=1))
    if not known.any():  # also where only one of both has embeddings
        return np.zeros(known.shape), np.zeros_like(known)
    cosines = (first @ second.T).astype(np.float64)
    return np.where(known, cosines - cosines[known].mean(), 0.0), known


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
class _OwnedVoxels:
    """Occupied voxels of owners (classes or instances) that are not parts of the building.

    Attributes:
        keys: [V] ascending; neighbours of one owner differ by a constant for each direction.
        steps: [13] these constants.
        centres_m: [V, 3].
        owners: [V].
    """

    keys: NDArray[np.int64]
    steps: NDArray[np.int64]
    centres_m: Array
    owners: NDArray[np.int64]

    @classmethod
    def of(cls, points_m: Array, owners: NDArray[np.integer]) -> _OwnedVoxels:
        """Find the voxels of points [N, 3] of owners [N]."""
        voxels = np.floor(points_m / _VOXEL_M).astype(np.int64)
        low = voxels.min(axis=0, initial=0)
        # One empty layer on each side, so that the neighbours of the last row are not in the next.
        shape = voxels.max(axis=0, initial=0) - low + 3
        strides = np.array([shape[1] * shape[2], shape[2], 1])
        volume = int(shape.prod())
        keys = np.unique(owners.astype(np.int64) * volume + (voxels - low + 1) @ strides)
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
