"""Colours of the semantic tree, and label images as pictures.

Each node has a region of colour space to itself: the whole of it is cut in two again and
again, in proportion to the classes on both sides, across whichever of hue, lightness and
chroma is longest there. Near the root that is hue, so a group's classes share a hue; where
hue is used up, lightness and chroma tell siblings apart. Within its region a node takes the
colour farthest from the others of its level.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.io.pictures import LegendEntry, Panel, Picture, colour_picture, legend_below, strip
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_parsing import VOID_NAME

VOID_COLOUR = (0, 0, 0)
_VOID = -1  # as a node index

# Colours to choose from lie on a grid of this step in Oklab: some seven thousand. They are
# neither near black, which is void, nor near the white of paper, nor grey, nor neon.
_STEP = 0.014
_LIGHTNESS = (0.42, 0.9)
_CHROMA = (0.06, 0.225)
# A radian of hue is so long beside lightness and chroma: twice the arc at medium chroma, for
# hue is to be cut first.
_HUE_LENGTH = 0.26
_FIRST_HUE_RAD = -0.3  # between magenta and red: two groups become warm and cool
_GAP = 0.2  # share of the smaller side that a cut leaves unused
_SWEEPS = 4  # after which colours hardly move

_CONES_FROM_RGB = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB_FROM_CONES = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)

Colours = NDArray[np.uint8]


class Palette:
    """One colour for each node of a tree, the same at every level and in every run.

    Attributes:
        taxonomy: the tree.
        nodes: [M, 3] uint8 RGB, as `taxonomy.nodes` counts.
        classes: [C + 1, 3] uint8 RGB by class id; void is black.
    """

    def __init__(self, taxonomy: Taxonomy) -> None:
        self.taxonomy = taxonomy
        self.nodes = _node_colours(taxonomy)
        leaves = self.nodes[taxonomy.node_ids[:, -1]]
        self.classes = np.concatenate([np.array([VOID_COLOUR], np.uint8), leaves])

    def picture(self, node_ids: NDArray[np.integer]) -> Picture:
        """Node indices [H, W], of one level or several, as colours; -1 is black.

        `taxonomy.level_ids` gives them for class ids.
        """
        # The last row is void's, and -1 its index.
        return np.concatenate([self.nodes, self.classes[:1]])[node_ids]

    def legend(self, node_ids: NDArray[np.integer]) -> list[LegendEntry]:
        """What appears in an image of node indices, and on which share of it, largest first.

        Void comes last. Names that several nodes have are given with those above them.
        """
        found, counts = np.unique(node_ids, return_counts=True)
        names = _names(self.taxonomy, [int(i) for i in found if i != _VOID])
        names[_VOID] = VOID_NAME
        order = sorted(
            range(len(found)), key=lambda k: (found[k] == _VOID, -counts[k], int(found[k]))
        )
        colours = self.picture(found)
        return [
            LegendEntry(
                f"{names[int(found[k])]} {_percent(counts[k] / node_ids.size)}",
                (int(colours[k, 0]), int(colours[k, 1]), int(colours[k, 2])),
            )
            for k in order
        ]

    def level_strip(
        self,
        rgb: NDArray[np.floating],
        levels: Sequence[NDArray[np.integer]],
        overlay: float = 1.0,
        legend_rows: int = 0,
    ) -> Picture:
        """Colour and every level of the tree side by side.

        Args:
            rgb: [H, W, 3] in [0, 1].
            levels: node indices [H, W] at each level, -1 void, coarsest first.
            overlay: how much of the semantic colour covers the image, in [0, 1].
            legend_rows: entries of the legend below each panel.
        """
        photo = colour_picture(rgb)
        panels = [Panel("colour", legend_below(photo, [], legend_rows))]
        for name, node_ids in zip(self.taxonomy.levels, levels, strict=True):
            mixed = overlay * self.picture(node_ids) + (1.0 - overlay) * photo
            picture = np.rint(mixed).astype(np.uint8)
            panels.append(Panel(name, legend_below(picture, self.legend(node_ids), legend_rows)))
        return strip(panels)


def _srgb(lab: NDArray[np.float64]) -> tuple[Colours, NDArray[np.bool_]]:
    """sRGB [N, 3] of Oklab colours, and which of them a screen can show."""
    cones = (lab @ np.linalg.inv(_LAB_FROM_CONES).T) ** 3
    linear = cones @ np.linalg.inv(_CONES_FROM_RGB).T
    shown = np.all((linear >= 0.0) & (linear <= 1.0), axis=1)
    linear = np.clip(linear, 0.0, 1.0)
    values = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * values).astype(np.uint8), shown


@functools.cache
def _choice() -> tuple[Colours, NDArray[np.float64], NDArray[np.float64]]:
    """Colours to choose from: sRGB, Oklab, and hue, lightness, chroma in comparable lengths."""
    lightness = np.arange(*_LIGHTNESS, _STEP)
    chroma_axis = np.arange(-_CHROMA[1], _CHROMA[1] + _STEP, _STEP)
    grid = np.meshgrid(lightness, chroma_axis, chroma_axis, indexing="ij")
    lab = np.stack(grid, axis=-1).reshape(-1, 3)
    rgb, shown = _srgb(lab)
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    kept = shown & (chroma >= _CHROMA[0]) & (chroma <= _CHROMA[1])
    hue = np.mod(np.arctan2(lab[:, 2], lab[:, 1]) - _FIRST_HUE_RAD, 2.0 * np.pi)
    axes = np.stack([_HUE_LENGTH * hue, lab[:, 0], chroma], axis=1)
    return rgb[kept], lab[kept], axes[kept]


def _node_colours(taxonomy: Taxonomy) -> Colours:
    """Colours [M, 3] of all nodes."""
    rgb, lab, axes = _choice()
    regions = _regions(taxonomy, axes)
    eligible = [
        region if node.leaf else _heart(region, axes)
        for node, region in zip(taxonomy.nodes, regions, strict=True)
    ]
    chosen = np.array([_middle(members, lab) for members in eligible])
    settled: set[int] = set()
    # The classes first: they are the most, and have the least room.
    for level in reversed(range(taxonomy.depth)):
        nodes = np.unique(taxonomy.node_ids[:, level])
        for _ in range(_SWEEPS):
            for node in nodes:
                others = lab[chosen[nodes[nodes != node]]]
                if int(node) in settled or len(others) == 0:
                    continue
                members = eligible[node]
                squares = ((lab[members][:, None] - others) ** 2).sum(axis=2)
                chosen[node] = members[squares.min(axis=1).argmax()]
        settled.update(int(node) for node in nodes)
    return rgb[chosen]


def _regions(taxonomy: Taxonomy, axes: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Indices of the colours that belong to each node, its descendants' among them."""
    children: dict[tuple[str, ...], list[int]] = {}
    for number, node in enumerate(taxonomy.nodes):
        children.setdefault(node.path[:-1], []).append(number)
    regions = [np.empty(0, np.intp)] * len(taxonomy.nodes)

    def share_out(siblings: list[int], members: NDArray[np.intp]) -> None:
        if len(siblings) > 1:
            first, rest, share = _halves(siblings, taxonomy)
            below, above = _cut(members, axes, share)
            share_out(first, below)
            share_out(rest, above)
            return
        regions[siblings[0]] = members
        if grandchildren := children.get(taxonomy.nodes[siblings[0]].path):
            share_out(grandchildren, members)

    share_out(children[()], np.arange(len(axes)))
    return regions


def _halves(siblings: list[int], taxonomy: Taxonomy) -> tuple[list[int], list[int], float]:
    """Siblings in two parts of about as many classes, and the first part's share of them."""
    classes = np.cumsum([len(taxonomy.nodes[i].class_ids) for i in siblings])
    shares = classes[:-1] / classes[-1]
    last = int(np.abs(shares - 0.5).argmin())
    return siblings[: last + 1], siblings[last + 1 :], float(shares[last])


def _cut(
    members: NDArray[np.intp], axes: NDArray[np.float64], share: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """A region in two across its longest axis, with a gap between them; none is empty."""
    low, high = np.percentile(axes[members], (2, 98), axis=0)
    along = axes[members, int((high - low).argmax())]
    ordered = members[np.argsort(along, kind="stable")]
    middle = round(share * len(ordered))
    gap = int(_GAP * len(ordered) * min(share, 1.0 - share)) // 2
    end, start = max(middle - gap, 1), min(middle + gap, len(ordered) - 1)
    return ordered[:end], ordered[start:]


def _heart(region: NDArray[np.intp], axes: NDArray[np.float64]) -> NDArray[np.intp]:
    """The vivid colours of a region's middle hues: they stand for a whole group."""
    hue, chroma = axes[region, 0], axes[region, 2]
    low, high = np.percentile(hue, (25, 75))
    central = (hue >= low) & (hue <= high)
    return region[central & (chroma >= np.percentile(chroma[central], 60))]


def _middle(members: NDArray[np.intp], lab: NDArray[np.float64]) -> int:
    squares = ((lab[members] - lab[members].mean(axis=0)) ** 2).sum(axis=1)
    return int(members[squares.argmin()])


def _names(taxonomy: Taxonomy, nodes: Sequence[int]) -> dict[int, str]:
    """The shortest ends of the nodes' paths that tell them apart."""
    paths = {i: taxonomy.nodes[i].path for i in nodes}
    names = {}
    for i, path in paths.items():
        longest = max((_common_end(path, other) for j, other in paths.items() if j != i), default=0)
        names[i] = " > ".join(path[-(longest + 1) :])
    return names


def _common_end(one: tuple[str, ...], other: tuple[str, ...]) -> int:
    """How many names two paths have in common at their ends."""
    same = 0
    while same < min(len(one), len(other)) and one[-1 - same] == other[-1 - same]:
        same += 1
    return same


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %" if share >= 0.0005 else "< 0.1 %"
