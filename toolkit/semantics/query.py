"""Questions to a labelled map: what is there, how many, where, how large.

A Gaussian belongs to a class or group where the map names it at the level of that node: it
may be sure of the group and unsure of the class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.geometry.open3d_bridge import open3d
from toolkit.io.splats import SplatLabels
from toolkit.semantics.boxes import Ground, OrientedBox, oriented_box
from toolkit.semantics.taxonomy import VOID, VOID_NAME, Node, Taxonomy

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Names that classes of the floor have, and of what lies on it.
FLOOR_NAMES = ("floor", "ground", "rug", "carpet")
CEILING_NAMES = ("ceiling",)

# Without a floor, the lowest Gaussians but for so many strays lie on it.
_LOWEST_PERCENT = 0.5
# A core point of DBSCAN has so many neighbours, itself among them.
_LEAST_NEIGHBOURS = 4


@dataclass(frozen=True)
class ObjectOptions:
    """What counts as one object.

    Attributes:
        link_m: Gaussians nearer to each other are of one object.
        min_gaussians: what has fewer is noise.
        min_confidence: Gaussians less sure of what they are do not count, in [0, 1].
    """

    link_m: float = 0.06
    min_gaussians: int = 50
    min_confidence: float = 0.0


@dataclass(frozen=True)
class SceneObject:
    """A connected piece of a class, or of a group where the map is unsure of the class.

    Attributes:
        node: what it is.
        index: [n] which Gaussians.
        confidence: their mean, in [0, 1].
        box: around their centres.
    """

    node: Node
    index: NDArray[np.intp]
    confidence: float
    box: OrientedBox

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.index)


@dataclass(frozen=True)
class LabelledMap:
    """Gaussians that know what they are.

    Attributes:
        means_m: [N, 3] float64, in the map's frame.
        labels: what each is.
        taxonomy: the tree that the labels refer to.

    Raises:
        FormatError: the labels are not of this tree.
        ValueError: there are more or fewer labels than Gaussians.
    """

    means_m: Array
    labels: SplatLabels
    taxonomy: Taxonomy

    def __post_init__(self) -> None:
        if self.means_m.shape != (len(self.labels), 3):
            raise ValueError(
                f"means_m must have shape [{len(self.labels)}, 3], got {list(self.means_m.shape)}"
            )
        check_labels(self.labels, self.taxonomy)

    def __len__(self) -> int:
        return len(self.means_m)

    def members(self, node: Node | None, min_confidence: float = 0.0) -> Mask:
        """Which Gaussians [N] are of a class or group, or of any, at least so surely."""
        sure = self.labels.confidence >= min_confidence
        if node is None:
            return sure & (self.labels.levels >= 0).any(axis=1)
        return sure & (self.labels.levels[:, node.level] == self.taxonomy.nodes.index(node))

    def selected(self, names: Sequence[str], min_confidence: float = 0.0) -> Mask:
        """Which Gaussians [N] are of any of these classes and groups; "void" has no class.

        Raises:
            FormatError: a name is none of the tree, or is that of several nodes.
        """
        mask = np.zeros(len(self), bool)
        for name in names:
            if name.strip().casefold() == VOID_NAME:
                mask |= self.labels.label == VOID
            else:
                mask |= self.members(self.taxonomy.find(name), min_confidence)
        return mask

    def counts(self) -> NDArray[np.int64]:
        """Number of Gaussians [M] of every node of the tree."""
        total = np.zeros(len(self.taxonomy.nodes), np.int64)
        for number, node in enumerate(self.taxonomy.nodes):
            total[number] = (self.labels.levels[:, node.level] == number).sum()
        return total

    def ground(self, floor: Sequence[str] = FLOOR_NAMES) -> Ground | None:
        """The plane of the floor's classes, or below the ceiling's; None where neither tells.

        Args:
            floor: classes and groups of the floor; those that the tree lacks do not matter.
        """
        below = self._plane(floor)
        if below is not None:
            return below
        ceiling = self._plane(CEILING_NAMES)
        if ceiling is None:
            return None
        heights_m = self.means_m @ -ceiling.up
        return Ground(-ceiling.up, float(np.percentile(heights_m, _LOWEST_PERCENT)))

    def _plane(self, names: Sequence[str]) -> Ground | None:
        """The plane of some classes, "up" being where everything else is."""
        members = self.selected(self.known(names))
        if not members.any() or members.all():
            return None
        return Ground.below(self.means_m[members], self.means_m[~members])

    def known(self, names: Sequence[str]) -> list[str]:
        """Those of the names that the tree has, as one node."""
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
        """Connected pieces of each class below a node, or of all classes; the largest first.

        Args:
            node: a class or group; Gaussians unsure of their class are pieces of their group.
            ground: what boxes stand on; they are free without one.
            options: what counts as one object.
        """
        kinds = np.where(self.members(node, options.min_confidence), self._finest(node), -1)
        found = []
        for kind in np.unique(kinds[kinds >= 0]):
            index = np.flatnonzero(kinds == kind)
            for piece in self.pieces(index, options):
                confidence = float(self.labels.confidence[piece].mean())
                box = oriented_box(self.means_m[piece], ground)
                found.append(SceneObject(self.taxonomy.nodes[kind], piece, confidence, box))
        return sorted(found, key=lambda o: (-len(o), o.index[0]))

    def pieces(self, index: NDArray[np.intp], options: ObjectOptions) -> list[NDArray[np.intp]]:
        """The connected pieces of some Gaussians, without what is noise."""
        found = [index[piece] for piece in connected(self.means_m[index], options.link_m)]
        return [piece for piece in found if len(piece) >= options.min_gaussians]

    def _finest(self, above: Node | None) -> NDArray[np.int32]:
        """Node index [N] of the finest level at which each Gaussian is known, -1 for none."""
        levels = self.labels.levels
        finest = np.full(len(self), -1, np.int32)
        for column in levels.T:
            finest = np.where(column >= 0, column, finest)
        if above is None:
            return finest
        # Levels may be decoded one by one and disagree.
        depth = len(above.path)
        within = np.array([n.path[:depth] == above.path for n in self.taxonomy.nodes])
        return np.where(within[finest], finest, self.taxonomy.nodes.index(above))


def check_labels(labels: SplatLabels, taxonomy: Taxonomy) -> None:
    """Check that labels can be of a tree.

    Raises:
        FormatError: they refer to levels, classes or nodes that the tree does not have, or
            their confidence is none.
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
            f"the labels hold class {wrong}, taxonomy '{name}' has classes 1 to {len(taxonomy)}; "
            "give the taxonomy that the map was made with"
        )
    for level in range(taxonomy.depth):
        strange = np.setdiff1d(levels[:, level], [-1, *taxonomy.node_ids[:, level]])
        if len(strange):
            raise FormatError(
                f"the labels hold node {strange[0]} at level {level}, where taxonomy '{name}' has "
                "no such node; give the taxonomy that the map was made with"
            )


def connected(points_m: Array, link_m: float) -> list[NDArray[np.intp]]:
    """Indices of each connected piece of points [N, 3], the largest first; noise is dropped.

    DBSCAN (Open3D) over the means of cells half a link wide: a wall of a hundred thousand
    Gaussians has some thousand of these, and they are the same in every run.
    """
    if len(points_m) == 0:
        return []
    keys = np.floor(points_m / (link_m / 2)).astype(np.int64)
    _, cells, sizes = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    cells = cells.reshape(-1)
    sums = [np.bincount(cells, weights=axis) for axis in points_m.T]
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(
        o3d.utility.Vector3dVector(np.stack(sums, axis=1) / sizes[:, None])
    )
    pieces = np.asarray(cloud.cluster_dbscan(link_m, _LEAST_NEIGHBOURS))[cells]
    found = [np.flatnonzero(pieces == piece) for piece in range(pieces.max() + 1)]
    return sorted(found, key=len, reverse=True)
