"""Queries on a labelled map: Gaussians and objects by class, with counts, positions and sizes.

A Gaussian belongs to a class or group if its label at the level of that node is the node. The
group of a Gaussian can be known while its class is not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.splat_labels import SplatLabels
from toolkit.scene.graph.boxes import Ground, OrientedBox, oriented_box
from toolkit.scene.graph.storeys import (
    MIN_STOREY_M,
    Floors,
    Storeys,
    find_storeys,
    lowest_floor,
)
from toolkit.semantics.options import ObjectOptions
from toolkit.semantics.taxonomy import VOID, VOID_NAME, Node, Taxonomy

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Class names of the floor and of floor coverings.
FLOOR_NAMES = ("floor", "ground", "rug", "carpet")
CEILING_NAMES = ("ceiling",)

# If no floor is labelled, its height is this percentile of the Gaussians' heights.
_LOWEST_PERCENT = 0.5
# Minimum number of neighbours of a DBSCAN core point, itself included.
_MIN_NEIGHBOURS = 4
# A fragment of an object, such as the leg of a chair that hardly touches the rest: the object has
# at least so many times its Gaussians, and its box, enlarged by so much, contains the fragment's
# centre.
_LARGER, _BESIDE_M = 4, 0.1
# Places on an axis of an ellipsoid, in standard deviations.
_ON_AXES = np.array([-1.0, -0.5, 0.5, 1.0])


@dataclass(frozen=True)
class SceneObject:
    """A connected set of Gaussians of one class, or of one group if their class is unknown.

    Attributes:
        node: class or group of the object.
        index: [n] indices of its Gaussians.
        points_m: [n, 3] centres of these.
        confidence: mean confidence of its Gaussians, in [0, 1].
        box: bounding box of their centres.
        instance: its number in a map with instances, 0 if it was found by connection.
        number: its place among the objects of the map.
    """

    node: Node
    index: NDArray[np.intp]
    points_m: Array
    confidence: float
    box: OrientedBox
    instance: int = 0
    number: int = 0

    def moved(self, T: Array) -> SceneObject:
        """Return the object moved by a rigid motion [4, 4]."""
        points_m = se3.transform_points(T, self.points_m)
        return replace(self, points_m=points_m, box=self.box.moved(T))

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.index)


@dataclass(frozen=True)
class LabelledMap:
    """Gaussians with labels.

    Objects are the instances of the labels. Gaussians without an instance, and maps without
    instances, form objects by connection; fragments that hardly touch an object belong to it.

    Attributes:
        means_m: [N, 3] float64, centres in the map frame, in metres.
        labels: label of each Gaussian.
        taxonomy: the tree that the labels refer to.
        axes_m: [N, 3, 3] the axes (rows) of ellipsoids, as long as the standard deviations; None
            for spheres. They bridge the distances between the centres of large ellipsoids.

    Raises:
        FormatError: the labels do not belong to this tree.
        ValueError: the numbers of labels and Gaussians differ.
    """

    means_m: Array
    labels: SplatLabels
    taxonomy: Taxonomy
    axes_m: Array | None = None

    def __post_init__(self) -> None:
        if self.means_m.shape != (len(self.labels), 3):
            raise ValueError(
                f"means_m must have shape [{len(self.labels)}, 3], got {list(self.means_m.shape)}"
            )
        check_labels(self.labels, self.taxonomy)

    def __len__(self) -> int:
        return len(self.means_m)

    def members(self, node: Node | None, min_confidence: float = 0.0) -> Mask:
        """Return the mask [N] of the Gaussians of a class or group, or of any if `node` is None."""
        confident = self.labels.confidence >= min_confidence
        if node is None:
            return confident & (self.labels.levels >= 0).any(axis=1)
        return confident & (self.labels.levels[:, node.level] == self.taxonomy.nodes.index(node))

    def selected(self, names: Sequence[str], min_confidence: float = 0.0) -> Mask:
        """Return the mask [N] of the Gaussians of any of these classes and groups.

        The name "void" selects the Gaussians without a class.

        Raises:
            FormatError: a name is not in the tree, or is ambiguous.
        """
        mask = np.zeros(len(self), bool)
        for name in names:
            if name.strip().casefold() == VOID_NAME:
                mask |= self.labels.label == VOID
            else:
                mask |= self.members(self.taxonomy.find(name), min_confidence)
        return mask

    def counts(self) -> NDArray[np.int64]:
        """Return the number of Gaussians [M] of every node of the tree."""
        total = np.zeros(len(self.taxonomy.nodes), np.int64)
        for number, node in enumerate(self.taxonomy.nodes):
            total[number] = (self.labels.levels[:, node.level] == number).sum()
        return total

    def ground(self, floor: Sequence[str] = FLOOR_NAMES) -> Ground | None:
        """Return the plane of the floor, or None if it cannot be determined.

        It is fitted to the classes of the floor; if there are several storeys, it is the floor of
        the lowest one. If there are none, it is the plane parallel to
        the ceiling at the height of the lowest Gaussians.

        Args:
            floor: classes and groups of the floor; names that are not in the tree are ignored.
        """
        members = self.selected(self.known(floor))
        if members.any() and not members.all():
            below = lowest_floor(self.means_m[members], self.means_m[~members])
            if below is not None:
                return below
        ceiling = self._plane(CEILING_NAMES)
        if ceiling is None:
            return None
        heights_m = self.means_m @ -ceiling.up
        return Ground(-ceiling.up, float(np.percentile(heights_m, _LOWEST_PERCENT)))

    def floors(self, floor: Sequence[str] = FLOOR_NAMES) -> Floors | None:
        """Return the floors of all storeys, or None without a plane of the floor; see `ground`."""
        ground = self.ground(floor)
        if ground is None:
            return None
        heights_m = self.means_m[self.selected(self.known(floor))] @ ground.up
        storeys = find_storeys(heights_m, ground.height_m)
        above = [h for h in storeys.heights_m if h - ground.height_m >= MIN_STOREY_M]
        return Floors(ground, Storeys([ground.height_m, *above]))

    def _plane(self, names: Sequence[str]) -> Ground | None:
        """Fit a plane to some classes; its normal points towards the other Gaussians."""
        members = self.selected(self.known(names))
        if not members.any() or members.all():
            return None
        return Ground.below(self.means_m[members], self.means_m[~members])

    def known(self, names: Sequence[str]) -> list[str]:
        """Return the names that identify exactly one node of the tree."""
        found = []
        for name in names:
            try:
                self.taxonomy.find(name)
            except FormatError:
                continue
            found.append(name)
        return found

    def objects(
        self, node: Node | None, ground: Ground | None, options: ObjectOptions
    ) -> list[SceneObject]:
        """Return the objects of each class below a node, or of all classes, largest first.

        Args:
            node: a class or group; Gaussians of unknown class form objects of their group.
            ground: boxes are upright on this plane; None allows any orientation.
            options: options of the extraction of objects.
        """
        kinds = np.where(self.members(node, options.min_confidence), self._finest(node), -1)
        found = list(self._instances(kinds, ground, options))
        if self.labels.instances is not None:
            kinds[self.labels.instances > 0] = -1
        for kind in np.unique(kinds[kinds >= 0]):
            index = np.flatnonzero(kinds == kind)
            found += self._connected(int(kind), self.pieces(index, options), ground)
        found = sorted(found, key=lambda o: (-len(o), o.index[0]))
        return [replace(one, number=number) for number, one in enumerate(found)]

    def _instances(
        self, kinds: NDArray[np.int32], ground: Ground | None, options: ObjectOptions
    ) -> Iterator[SceneObject]:
        """Yield the instances whose most frequent kind is one of those selected.

        Args:
            kinds: [N] selected kind of each Gaussian, -1 for Gaussians that are not selected.
        """
        instances = self.labels.instances
        if instances is None:
            return
        confident = self.labels.confidence >= options.min_confidence
        order = np.argsort(instances, kind="stable")
        starts = np.flatnonzero(np.diff(instances[order]))
        for index in np.split(order, starts + 1):
            index = index[confident[index]]
            if not len(index) or instances[index[0]] <= 0:
                continue
            names, counts = np.unique(kinds[index], return_counts=True)
            kind = int(names[counts.argmax()])
            pieces = self.pieces(np.sort(index), options) if kind >= 0 else []
            if pieces:
                members = np.sort(np.concatenate(pieces))
                yield self._object(kind, members, ground, int(instances[index[0]]))

    def _connected(
        self, kind: int, pieces: Sequence[NDArray[np.intp]], ground: Ground | None
    ) -> list[SceneObject]:
        """Return the objects of the connected components of a kind, largest first, joined."""
        bodies: list[SceneObject] = []
        parts: list[list[NDArray[np.intp]]] = []
        for piece in pieces:
            found = self._object(kind, piece, ground)
            owner = next((n for n, of in enumerate(bodies) if _is_fragment(found, of)), None)
            if owner is None:
                bodies.append(found)
                parts.append([])
            else:
                parts[owner].append(piece)
        return [
            self._object(kind, np.sort(np.concatenate([body.index, *more])), ground)
            if more
            else body
            for body, more in zip(bodies, parts, strict=True)
        ]

    def _object(
        self, kind: int, index: NDArray[np.intp], ground: Ground | None, instance: int = 0
    ) -> SceneObject:
        confidence = float(self.labels.confidence[index].mean())
        points_m = self.means_m[index]
        box = oriented_box(points_m, ground)
        return SceneObject(self.taxonomy.nodes[kind], index, points_m, confidence, box, instance)

    def pieces(self, index: NDArray[np.intp], options: ObjectOptions) -> list[NDArray[np.intp]]:
        """Return the connected components of some Gaussians, without noise."""
        axes_m = None if self.axes_m is None else self.axes_m[index]
        pieces = connected(self.means_m[index], options.link_m, axes_m)
        found = [index[piece] for piece in pieces]
        return [piece for piece in found if len(piece) >= options.min_gaussians]

    def _finest(self, above: Node | None) -> NDArray[np.int32]:
        """Return the index [N] of the most specific known node of each Gaussian, -1 for none."""
        levels = self.labels.levels
        finest = np.full(len(self), -1, np.int32)
        for column in levels.T:
            finest = np.where(column >= 0, column, finest)
        if above is None:
            return finest
        # Levels are decoded independently and can be inconsistent.
        depth = len(above.path)
        within = np.array([n.path[:depth] == above.path for n in self.taxonomy.nodes])
        return np.where(within[finest], finest, self.taxonomy.nodes.index(above))


def _is_fragment(item: SceneObject, body: SceneObject) -> bool:
    """Whether an object is a fragment of a larger one of its class."""
    if len(body) < _LARGER * len(item):
        return False
    return body.box.contains(item.box.centre_m, _BESIDE_M)


def check_labels(labels: SplatLabels, taxonomy: Taxonomy) -> None:
    """Check that labels are consistent with a tree.

    Raises:
        FormatError: they refer to levels, classes or nodes that the tree does not have, or
            a confidence is outside [0, 1].
    """
    name, levels = taxonomy.name, labels.levels
    if levels.shape[1] != taxonomy.depth:
        raise FormatError(
            f"the labels have {levels.shape[1]} levels, taxonomy '{name}' has {taxonomy.depth}; "
            "give the taxonomy that the map was made with"
        )
    if len(labels) == 0:
        return
    if not ((labels.confidence >= 0.0) & (labels.confidence <= 1.0)).all():
        raise FormatError("the labels have confidences outside 0 to 1; write the map again")
    if labels.label.min() < VOID or labels.label.max() > len(taxonomy):
        wrong = labels.label.max() if labels.label.max() > len(taxonomy) else labels.label.min()
        raise FormatError(
            f"the labels contain class {wrong}, taxonomy '{name}' has classes 1 to "
            f"{len(taxonomy)}; "
            "give the taxonomy that the map was made with"
        )
    for level in range(taxonomy.depth):
        unknown = np.setdiff1d(levels[:, level], [-1, *taxonomy.node_ids[:, level]])
        if len(unknown):
            raise FormatError(
                f"the labels contain node {unknown[0]} at level {level}, which taxonomy '{name}' "
                "does not have; give the taxonomy that the map was made with"
            )


def connected(
    points_m: Array, link_m: float, axes_m: Array | None = None
) -> list[NDArray[np.intp]]:
    """Return the indices of each connected component of points [N, 3], largest first.

    Noise is dropped. Uses DBSCAN (Open3D) on the means of voxels of half the link distance: this
    is deterministic and reduces a wall of 100 000 Gaussians to some thousand points.

    Args:
        points_m: centres.
        link_m: maximum distance of neighbours.
        axes_m: [N, 3, 3] axes of ellipsoids around the points; see `LabelledMap`.
    """
    count = len(points_m)
    if count == 0:
        return []
    if axes_m is not None:
        points_m = np.concatenate([points_m, _along_axes(points_m, axes_m, link_m)])
    keys = np.floor(points_m / (link_m / 2)).astype(np.int64)
    _, cells, sizes = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    cells = cells.reshape(-1)
    sums = [np.bincount(cells, weights=axis) for axis in points_m.T]
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(
        o3d.utility.Vector3dVector(np.stack(sums, axis=1) / sizes[:, None])
    )
    pieces = np.asarray(cloud.cluster_dbscan(link_m, _MIN_NEIGHBOURS))[cells[:count]]
    found = [np.flatnonzero(pieces == piece) for piece in range(pieces.max() + 1)]
    return sorted([piece for piece in found if len(piece)], key=len, reverse=True)


def _along_axes(points_m: Array, axes_m: Array, link_m: float) -> Array:
    """Points [M, 3] on the axes of ellipsoids that are longer than half the link distance."""
    owner, axis = np.nonzero(np.linalg.norm(axes_m, axis=2) > link_m / 2)
    steps = _ON_AXES[:, None, None] * axes_m[owner, axis]
    return np.asarray(points_m[owner] + steps).reshape(-1, 3)
