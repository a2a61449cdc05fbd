"""Levels of detail of a large map: an octree whose inner nodes hold merged Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.io.morton import morton_codes
from toolkit.tools.viewer.moments import Moments
from toolkit.tools.viewer.scene import ShownSplats

# Cells along each axis of a region, as a power of two, and the highest number of regions. Each
# region has its own cube, so that a few Gaussians far away do not make the cells of the map coarse.
_BITS, _REGIONS = 20, 8
# The cube of a region contains this share of its Gaussians, with a margin relative to their extent.
_SHARE_PERCENT, _MARGIN = (1.0, 99.0), 0.5
_SMALLEST_M = 1e-6
# Maximum number of Gaussians of a leaf. Inner nodes have about half as many at most, or the levels
# above the last one would be as large as the map.
NODE_SIZE = 8192
# The root has more, because it is the first picture.
ROOT_SIZE = 32768


@dataclass
class DetailNode:
    """A node of the tree.

    Attributes:
        first, last: range of its Gaussians in the order of the tree.
        box_m: [2, 3] float32 lowest and highest coordinates of their centres.
        cell_m: side of the cells whose Gaussians are merged; 0 for leaves.
        children: numbers of the children, which follow each other; empty for leaves.
        merged: the merged Gaussians of an inner node.
    """

    first: int
    last: int
    box_m: NDArray[np.float32]
    cell_m: float = 0.0
    children: range = range(0)
    merged: ShownSplats | None = None


@dataclass(frozen=True)
class DetailTree:
    """All Gaussians in an order in which those of each node follow each other.

    Attributes:
        splats: N Gaussians.
        nodes: the nodes, breadth first; the root is the first.
    """

    splats: ShownSplats
    nodes: list[DetailNode]

    @classmethod
    def build(
        cls, splats: ShownSplats, node_size: int = NODE_SIZE, root_size: int = ROOT_SIZE
    ) -> DetailTree:
        """Build the tree.

        Args:
            splats: N >= 1 Gaussians in any order.
            node_size: maximum number of Gaussians of a leaf, unless all are at one point.
            root_size: about the maximum number of merged Gaussians of the root.
        """
        curve = _Curve.through(splats.means_m)
        builder = _Builder(splats.select(curve.order), curve, node_size, root_size)
        return cls(builder.splats, builder.nodes)

    def count(self, number: int) -> int:
        """Return the number of Gaussians of a node."""
        node = self.nodes[number]
        return node.last - node.first if node.merged is None else len(node.merged)

    def content(self, number: int) -> ShownSplats:
        """Return the Gaussians of a node: its own for a leaf, merged ones otherwise."""
        node = self.nodes[number]
        if node.merged is not None:
            return node.merged
        return self.splats.select(slice(node.first, node.last))


@dataclass(frozen=True)
class _Curve:
    """The order of the Gaussians.

    Attributes:
        order: [N] numbers of the Gaussians.
        codes: [N] numbers of their cells, ascending; the highest bits are those of the region.
        sides_m: sides of the cubes of the regions.
    """

    order: NDArray[np.intp]
    codes: NDArray[np.int64]
    sides_m: list[float]

    @classmethod
    def through(cls, means_m: NDArray[np.float32]) -> _Curve:
        codes = np.zeros(len(means_m), np.int64)
        rest, sides_m = np.arange(len(means_m)), []
        for region in range(_REGIONS):
            points_m = means_m if len(rest) == len(means_m) else means_m[rest]
            low_m, side_m = _cube(points_m, whole=region == _REGIONS - 1)
            inside = np.ones(len(points_m), bool)
            for axis, low in enumerate(low_m):
                inside &= (points_m[:, axis] >= low) & (points_m[:, axis] <= low + side_m)
            own = morton_codes(points_m[inside], low_m, side_m, _BITS)
            codes[rest[inside]] = own | (region << (3 * _BITS))
            sides_m.append(side_m)
            rest = rest[~inside]
            if not len(rest):
                break
        order = np.argsort(codes, kind="stable")
        return cls(order, codes[order], sides_m)

    def cell_m(self, first: int, last: int, level: int) -> float:
        """Return the side of the cells of a level in a range of Gaussians."""
        low, high = (int(self.codes[i]) >> (3 * _BITS) for i in (first, last - 1))
        return max(self.sides_m[low : high + 1]) / 2.0 ** (_BITS - level)


def _cube(means_m: NDArray[np.float32], whole: bool) -> tuple[NDArray[np.float32], float]:
    """Return the lowest corner [3] and the side of a cube around most points, or all of them."""
    low_m, high_m = (np.array([f(means_m[:, i]) for i in range(3)]) for f in (np.min, np.max))
    if not whole:
        # Of large maps, some points are enough.
        some = means_m[:: max(len(means_m) // 100_000, 1)]
        inner_low, inner_high = np.percentile(some, _SHARE_PERCENT, axis=0)
        margin_m = _MARGIN * float((inner_high - inner_low).max())
        low_m = np.maximum(low_m, inner_low - margin_m)
        high_m = np.minimum(high_m, inner_high + margin_m)
    # Rounding must not leave out the highest point.
    side_m = max(float((high_m - low_m).max()) * (1.0 + 1e-6), _SMALLEST_M)
    return low_m.astype(np.float32), side_m


class _Builder:
    """Divides the curve into nodes, then merges from the leaves to the root."""

    def __init__(self, splats: ShownSplats, curve: _Curve, node_size: int, root_size: int) -> None:
        self.splats, self._curve = splats, curve
        self._node_size, self._root_size = node_size, root_size
        self._axes_m = np.ascontiguousarray(splats.means_m.T)
        self.nodes = [self._node(0, len(splats))]
        for node in self.nodes:  # grows
            self._divide(node)
        self._merge(0)

    def _node(self, first: int, last: int) -> DetailNode:
        axes_m = self._axes_m[:, first:last]
        return DetailNode(first, last, np.stack([axes_m.min(axis=1), axes_m.max(axis=1)]))

    def _divide(self, node: DetailNode) -> None:
        """Append the children of a node with too many Gaussians."""
        codes = self._curve.codes[node.first : node.last]
        different = int(codes[0]) ^ int(codes[-1])
        if len(codes) <= self._node_size or not different:
            return
        shift = 3 * ((different.bit_length() - 1) // 3)
        octants = np.unique(codes[[0, -1]] >> shift)
        bounds = np.searchsorted(codes >> shift, np.arange(octants[0], octants[-1] + 2))
        first_child = len(self.nodes)
        for begin, end in self._joined(np.unique(bounds).tolist()):
            self.nodes.append(self._node(node.first + begin, node.first + end))
        node.children = range(first_child, len(self.nodes))

    def _joined(self, bounds: list[int]) -> list[tuple[int, int]]:
        """Join neighbouring small octants, each of which would be a request of its own."""
        parts = [(bounds[0], bounds[1])]
        for begin, end in pairwise(bounds[1:]):
            if end - parts[-1][0] <= self._node_size:
                parts[-1] = (parts[-1][0], end)
            else:
                parts.append((begin, end))
        return parts

    def _merge(self, number: int) -> tuple[Moments, NDArray[np.int64]]:
        """Return the Gaussians of a node and their codes, merged in inner nodes."""
        node = self.nodes[number]
        if not node.children:
            own = self.splats.select(slice(node.first, node.last))
            return Moments.of(own), self._curve.codes[node.first : node.last]
        below = [self._merge(child) for child in node.children]
        moments = Moments.concatenate([part for part, _ in below])
        codes = np.concatenate([part for _, part in below])
        level = self._level(codes, self._node_size // 2 if number else self._root_size)
        cell_m = self._curve.cell_m(node.first, node.last, level)
        # The root may have finer cells than its children, whose detail it cannot exceed.
        node.cell_m = max(cell_m, *(self.nodes[child].cell_m for child in node.children))
        cells = codes >> (3 * level)
        begins = np.diff(cells, prepend=-1) > 0
        # A Gaussian larger than the cell would take in the small ones upon it.
        groups = 2 * np.cumsum(begins) - 2 + (moments.sizes_m > node.cell_m)
        merged = moments.merged(groups)
        node.merged = merged.shown(self.splats)
        present = np.flatnonzero(np.bincount(groups))
        return merged, (cells[begins] << (3 * level))[present // 2]

    def _level(self, codes: NDArray[np.int64], size: int) -> int:
        """Return the finest level of cells of which at most `size` are occupied."""
        # The number of bits in which neighbours on the curve differ.
        changes = codes[1:] ^ codes[:-1]
        finest = 0
        while finest < _BITS and 1 + np.count_nonzero(changes >> (3 * finest)) > size:
            finest += 1
        return finest
