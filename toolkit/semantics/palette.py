"""Colours of the semantic tree, and visualisation of label images.

Every node is assigned a region of the colour space. The space is split recursively, in proportion
to the number of classes on both sides, along the longest of the axes hue, lightness and chroma.
Near the root this is hue, so the classes of a group have similar hues. Farther down, siblings
differ in lightness and chroma. Within its region, a node takes the colour with the largest distance
to the other nodes of its level.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.io.visualisation import LegendEntry, Panel, RgbImage, colour_image, legend_below, strip
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_parsing import VOID_NAME

VOID_COLOUR = (0, 0, 0)
_VOID = -1  # as a node index

# Candidate colours are a grid in Oklab with this step, about 7000. Colours near black (void), white
# and grey and highly saturated colours are excluded.
_STEP = 0.014
_LIGHTNESS = (0.42, 0.9)
_CHROMA = (0.06, 0.225)
# Length of one radian of hue relative to lightness and chroma: twice the arc at medium chroma, so
# that hue is split first.
_HUE_LENGTH = 0.26
_FIRST_HUE_RAD = -0.3  # between magenta and red: two groups get warm and cool colours
_GAP = 0.2  # fraction of the smaller side that remains unused at a split
# Fraction of the circle of hues between objects with successive numbers, and their lightness and
# chroma in turn. Colours of objects whose numbers differ by up to 40 then differ by 25 or more in a
# channel, which other steps do not reach.
_HUE_STEP = 0.8455
_INSTANCE_LIGHTNESS = (0.72, 0.52, 0.86, 0.62, 0.79)
_INSTANCE_CHROMA = (0.14, 0.12, 0.1, 0.13, 0.12)
_SWEEPS = 4  # optimisation sweeps; the colours have nearly converged

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
    """A colour for each node of a tree; it depends on the tree only.

    Attributes:
        taxonomy: the tree.
        nodes: [M, 3] uint8 RGB, in the order of `taxonomy.nodes`.
        classes: [C + 1, 3] uint8 RGB by class id; void is black.
    """

    def __init__(self, taxonomy: Taxonomy) -> None:
        self.taxonomy = taxonomy
        self.nodes = _node_colours(taxonomy)
        leaves = self.nodes[taxonomy.node_ids[:, -1]]
        self.classes = np.concatenate([np.array([VOID_COLOUR], np.uint8), leaves])

    def class_image(self, node_ids: NDArray[np.integer]) -> RgbImage:
        """Return the colours of node indices [H, W] of any level; -1 (void) is black.

        `taxonomy.level_ids` converts class ids to node indices.
        """
        # The last row, index -1, is the colour of void.
        return np.concatenate([self.nodes, self.classes[:1]])[node_ids]

    def legend(self, node_ids: NDArray[np.integer]) -> list[LegendEntry]:
        """Return the nodes in an image of node indices with their area fraction, largest first.

        Void is last. Ambiguous names are preceded by the names of their parents.
        """
        found, counts = np.unique(node_ids, return_counts=True)
        names = _names(self.taxonomy, [int(i) for i in found if i != _VOID])
        names[_VOID] = VOID_NAME
        order = sorted(
            range(len(found)), key=lambda k: (found[k] == _VOID, -counts[k], int(found[k]))
        )
        colours = self.class_image(found)
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
        legend_rows: int = 0,
    ) -> RgbImage:
        """Return the colour image and the labels at every level side by side.

        Args:
            rgb: [H, W, 3] colours in [0, 1].
            levels: node indices [H, W] at each level, coarsest first; -1 is void.
            legend_rows: number of legend entries below each panel.
        """
        colours = colour_image(rgb)
        panels = [Panel("colour", legend_below(colours, [], legend_rows))]
        for name, node_ids in zip(self.taxonomy.levels, levels, strict=True):
            image = self.class_image(node_ids)
            panels.append(Panel(name, legend_below(image, self.legend(node_ids), legend_rows)))
        return strip(panels)


def _srgb(lab: NDArray[np.float64]) -> tuple[Colours, NDArray[np.bool_]]:
    """Convert Oklab colours to sRGB [N, 3]; also return which are inside the sRGB gamut."""
    cones = (lab @ np.linalg.inv(_LAB_FROM_CONES).T) ** 3
    linear = cones @ np.linalg.inv(_CONES_FROM_RGB).T
    shown = np.all((linear >= 0.0) & (linear <= 1.0), axis=1)
    linear = np.clip(linear, 0.0, 1.0)
    values = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * values).astype(np.uint8), shown


@functools.cache
def _candidates() -> tuple[Colours, NDArray[np.float64], NDArray[np.float64]]:
    """Return the candidate colours as sRGB, Oklab, and scaled hue, lightness and chroma."""
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


@functools.lru_cache(maxsize=8)
def _node_colours(taxonomy: Taxonomy) -> Colours:
    """Return the colours [M, 3] of all nodes, read only. A run needs those of its tree thrice."""
    rgb, lab, axes = _candidates()
    regions = _regions(taxonomy, axes)
    eligible = [
        region if node.leaf else _vivid_centre(region, axes)
        for node, region in zip(taxonomy.nodes, regions, strict=True)
    ]
    chosen = np.array([_central_colour(members, lab) for members in eligible])
    settled: set[int] = set()
    # Start with the classes, which are the most numerous and have the smallest regions.
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
    colours = rgb[chosen]
    colours.setflags(write=False)
    return colours


def _regions(taxonomy: Taxonomy, axes: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Return the indices of the colours of each node's region, which includes its descendants'."""
    children: dict[tuple[str, ...], list[int]] = {}
    for number, node in enumerate(taxonomy.nodes):
        children.setdefault(node.path[:-1], []).append(number)
    regions = [np.empty(0, np.intp)] * len(taxonomy.nodes)

    def assign(siblings: list[int], members: NDArray[np.intp]) -> None:
        if len(siblings) > 1:
            first, rest, fraction = _halves(siblings, taxonomy)
            below, above = _split(members, axes, fraction)
            assign(first, below)
            assign(rest, above)
            return
        regions[siblings[0]] = members
        if grandchildren := children.get(taxonomy.nodes[siblings[0]].path):
            assign(grandchildren, members)

    assign(children[()], np.arange(len(axes)))
    return regions


def _halves(siblings: list[int], taxonomy: Taxonomy) -> tuple[list[int], list[int], float]:
    """Split siblings into parts of similar numbers of classes; return the first one's fraction."""
    classes = np.cumsum([len(taxonomy.nodes[i].class_ids) for i in siblings])
    fractions = classes[:-1] / classes[-1]
    last = int(np.abs(fractions - 0.5).argmin())
    return siblings[: last + 1], siblings[last + 1 :], float(fractions[last])


def _split(
    members: NDArray[np.intp], axes: NDArray[np.float64], fraction: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Split a region along its longest axis into two non-empty parts with a gap between them."""
    low, high = np.percentile(axes[members], (2, 98), axis=0)
    along = axes[members, int((high - low).argmax())]
    ordered = members[np.argsort(along, kind="stable")]
    middle = round(fraction * len(ordered))
    gap = int(_GAP * len(ordered) * min(fraction, 1.0 - fraction)) // 2
    end, start = max(middle - gap, 1), min(middle + gap, len(ordered) - 1)
    return ordered[:end], ordered[start:]


def _vivid_centre(region: NDArray[np.intp], axes: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the saturated colours of a region's central hues, which represent a group."""
    hue, chroma = axes[region, 0], axes[region, 2]
    low, high = np.percentile(hue, (25, 75))
    central = (hue >= low) & (hue <= high)
    return region[central & (chroma >= np.percentile(chroma[central], 60))]


def _central_colour(members: NDArray[np.intp], lab: NDArray[np.float64]) -> int:
    squares = ((lab[members] - lab[members].mean(axis=0)) ** 2).sum(axis=1)
    return int(members[squares.argmin()])


def _names(taxonomy: Taxonomy, nodes: Sequence[int]) -> dict[int, str]:
    """Return the shortest suffix of each node's path that is unambiguous."""
    paths = {i: taxonomy.nodes[i].path for i in nodes}
    names = {}
    for i, path in paths.items():
        longest = max(
            (_common_suffix_length(path, other) for j, other in paths.items() if j != i), default=0
        )
        names[i] = " > ".join(path[-(longest + 1) :])
    return names


def _common_suffix_length(one: tuple[str, ...], other: tuple[str, ...]) -> int:
    """Return the number of names that two paths have in common at their ends."""
    same = 0
    while same < min(len(one), len(other)) and one[-1 - same] == other[-1 - same]:
        same += 1
    return same


def _percent(fraction: float) -> str:
    return f"{100.0 * fraction:.1f} %" if fraction >= 0.0005 else "< 0.1 %"


def instance_colours(count: int) -> Colours:
    """Return a colour [count + 1, 3] for each object by number; 0 is black.

    Objects with similar numbers, which are often neighbours, have different hues.
    """
    numbers = np.arange(count)
    hue = 2.0 * np.pi * np.mod(numbers * _HUE_STEP, 1.0)
    lightness = np.array(_INSTANCE_LIGHTNESS)[numbers % 5]
    chroma = np.array(_INSTANCE_CHROMA)[numbers % 5]
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=1)
    return np.concatenate([np.array([VOID_COLOUR], np.uint8), _srgb(lab)[0]])
