"""Maps as the server sends them: whole, or in levels of detail of which the page loads a part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.tools.viewer.detail_tree import NODE_SIZE, ROOT_SIZE, DetailTree
from toolkit.tools.viewer.packing import NO_NODE, PackedScene, overview, pack, pack_splats
from toolkit.tools.viewer.scene import ShownSplats, ViewerScene


class ServedMap(Protocol):
    """A map as the server sends it."""

    def packed(self) -> PackedScene:
        """Return what the page loads first."""
        ...

    def chunk(self, number: int) -> bytes | None:
        """Return a part that the page loads later; None if there is no such part."""
        ...


@dataclass(frozen=True)
class WholeMap:
    """A map that is sent at once.

    Attributes:
        scene: the scene, with one Gaussian or more.
        highlight: names of classes and groups that are highlighted at the start.
    """

    scene: ViewerScene
    highlight: str = ""

    def packed(self) -> PackedScene:
        """Return the scene."""
        packed = pack(self.scene)
        packed.header["highlight"] = self.highlight
        return packed

    def chunk(self, number: int) -> bytes | None:
        """There are no other parts."""
        return None


@dataclass(frozen=True)
class StreamedMap:
    """The coarsest level of a map, and chunks with the others.

    Attributes:
        scene: the scene, with all Gaussians in the order of the tree.
        tree: its levels of detail.
        budget: maximum number of Gaussians that a browser draws at once.
        highlight: names of classes and groups that are highlighted at the start.
    """

    scene: ViewerScene
    tree: DetailTree
    budget: int
    highlight: str = ""

    @classmethod
    def build(
        cls,
        scene: ViewerScene,
        budget: int,
        highlight: str = "",
        node_size: int = NODE_SIZE,
        root_size: int = ROOT_SIZE,
    ) -> StreamedMap:
        """Build the levels of detail of a scene; sizes as of `DetailTree.build`."""
        tree = DetailTree.build(scene.splats, node_size, root_size)
        whole = replace(scene, splats=tree.splats, total=len(tree.splats))
        return cls(whole, tree, budget, highlight)

    def chunk(self, number: int) -> bytes | None:
        """Return the packed Gaussians of a node, None if there is no such node."""
        if not 0 <= number < len(self.tree.nodes):
            return None
        return bytes(pack_splats(self.tree.content(number)))

    def packed(self) -> PackedScene:
        """Return the scene with the Gaussians of the root, and the boxes of all nodes."""
        nodes = self.tree.nodes
        packed = pack(replace(self.scene, splats=self.tree.content(0)))
        packed.add("nodeBoxes", np.stack([node.box_m.ravel() for node in nodes]))
        packed.add("nodeCells", np.array([node.cell_m for node in nodes], np.float32))
        counts = [self.tree.count(number) for number in range(len(nodes))]
        packed.add("nodeCounts", np.array(counts, np.int32))
        children = [(node.children.start, len(node.children)) for node in nodes]
        packed.add("nodeChildren", np.array(children, np.int32))
        packed.header |= {
            "stream": {"budget": max(self.budget, self.tree.count(0))},
            "overview": overview(self.scene.splats.means_m),
            "tallies": tallies(self.scene.splats),
            "highlight": self.highlight,
        }
        return packed


def tallies(splats: ShownSplats) -> dict[str, list[Any]]:
    """Return the numbers of Gaussians by class path, submap and source, as the page counts them."""
    result: dict[str, list[Any]] = {"classes": [], "submaps": [], "source": []}
    if splats.levels is not None:
        paths, counts = _distinct_rows(splats.levels)
        nodes = np.where(paths < 0, NO_NODE, paths)
        result["classes"] = [[n, c] for n, c in zip(nodes.tolist(), counts.tolist(), strict=True)]
    for name, values in (("submaps", splats.submap), ("source", splats.inferred)):
        if values is not None:
            found, counts = np.unique(values.astype(np.int64), return_counts=True)
            result[name] = np.stack([found, counts], axis=1).tolist()
    return result


def _distinct_rows(
    levels: NDArray[np.int32],
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the distinct rows [M, L] of nodes >= -1 [N, L], and how often each occurs."""
    keys = np.zeros(len(levels), np.int64)
    for column in levels.T:
        # Numbered anew at each level, so that the numbers remain small.
        keys = keys * (int(column.max()) + 2) + column + 1
        present = np.bincount(keys) > 0
        keys = (np.cumsum(present) - 1)[keys]
    counts = np.bincount(keys)
    some = np.empty(len(counts), np.int64)
    some[keys] = np.arange(len(keys))
    return levels[some], counts
