"""A taxonomy as a picture: boxes from left to right, from the top level to the classes.

A node is as tall as the classes below it, so that sizes are seen at a glance. A long tree is
cut into blocks that stand side by side.
"""

from __future__ import annotations

import colorsys
import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.errors import FormatError
from toolkit.io.atomic import replacing
from toolkit.semantics.taxonomy import Node, Taxonomy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUFFIXES = (".png", ".svg", ".pdf")

# Inches on paper, and points of type.
_ROW = 0.155
_TYPE = 7.0
_LETTER = 0.52 * _TYPE / 72  # width of an average letter
_NARROW, _WIDE = 0.6, 1.5  # of a level's column
_GAP = 0.3  # between blocks
_MARGIN, _HEAD = 0.15, 0.6
_PROPORTION = 1.5  # width by height that the whole tries for


@dataclass(frozen=True)
class _Box:
    """A node's part in one block: rows and columns, the upper ends not included."""

    node: Node
    rows: tuple[int, int]
    columns: tuple[int, int]


def draw_taxonomy(taxonomy: Taxonomy, path: str | Path, dpi: int = 120) -> None:
    """Write a picture of the tree.

    Args:
        path: ends in .png, .svg or .pdf.
        dpi: dots an inch of a PNG.

    Raises:
        FormatError: another ending.
        RunFolderError: the file cannot be written.
    """
    # The object interface alone: pyplot keeps figures, and settings, for the whole process.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise FormatError(f"{path}: a tree can be drawn as {', '.join(SUFFIXES)}")
    order = [n.class_ids[0] for n in taxonomy.nodes if n.leaf]
    columns = _column_edges(taxonomy)
    rows = _rows_a_block(len(order), columns[-1])
    blocks = [order[start : start + rows] for start in range(0, len(order), rows)]
    width = len(blocks) * (columns[-1] + _GAP) - _GAP + 2 * _MARGIN
    width = max(width, len(str(taxonomy)) * 1.6 * _LETTER + 2 * _MARGIN)
    height = rows * _ROW + _HEAD + _MARGIN
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    axes.text(_MARGIN, 0.24, str(taxonomy), fontsize=1.3 * _TYPE, weight="bold", va="center")
    for number, block in enumerate(blocks):
        left = _MARGIN + number * (columns[-1] + _GAP)
        edges = [left + edge for edge in columns]
        for level, name in enumerate(taxonomy.levels):
            axes.text(edges[level] + 0.03, 0.5, name, fontsize=_TYPE, color="0.4", va="center")
        for box in _boxes(taxonomy, block):
            _draw(axes, box, edges, _colour(taxonomy, box.node))
    # Without dates and names of versions, and with names that are no random numbers, the
    # same tree gives the same file.
    metadata = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with replacing(path) as temporary, rc_context({"svg.hashsalt": "semsplat"}):
        figure.savefig(temporary, dpi=dpi, metadata=metadata[path.suffix])


def _column_edges(taxonomy: Taxonomy) -> list[float]:
    """Left edges of the levels' columns, and the right edge of the last."""
    edges = [0.0]
    for level in range(taxonomy.depth):
        names = [n.name for n in taxonomy.nodes if n.level == level]
        longest = max(map(len, names)) * _LETTER + 0.1
        edges.append(edges[-1] + min(max(longest, _NARROW), _WIDE))
    return edges


def _rows_a_block(count: int, width: float) -> int:
    """Rows that make the whole about as wide as it should be."""
    blocks = math.sqrt(_PROPORTION * count * _ROW / (width + _GAP))
    return math.ceil(count / max(1, round(blocks)))


def _boxes(taxonomy: Taxonomy, block: Sequence[int]) -> Iterator[_Box]:
    """The nodes above some classes that stand below one another."""
    for level in range(taxonomy.depth):
        start = 0
        for row in range(1, len(block) + 1):
            node = taxonomy.ancestor(block[start], level)
            if row < len(block) and taxonomy.ancestor(block[row], level) is node:
                continue
            if node.level == level:
                last = taxonomy.depth if node.leaf else level + 1
                yield _Box(node, (start, row), (level, last))
            start = row


def _draw(axes: Axes, box: _Box, edges: Sequence[float], colour: Sequence[float]) -> None:
    from matplotlib.patches import Rectangle

    left, right = edges[box.columns[0]], edges[box.columns[1]]
    top, bottom = (_HEAD + row * _ROW for row in box.rows)
    axes.add_patch(
        Rectangle((left, top), right - left, bottom - top, facecolor=colour, edgecolor="white")
    )
    text, size = _fitted(box.node.name, right - left, box.rows[1] - box.rows[0])
    x, y = left + 0.04, (top + bottom) / 2
    axes.text(x, y, text, fontsize=size, va="center_baseline", linespacing=1.1)


def _fitted(name: str, width: float, rows: int) -> tuple[str, float]:
    """The name in as many lines as there is room for, and in smaller type if it must be."""
    letters = max(int((width - 0.08) / _LETTER), 1)
    lines = textwrap.wrap(name, letters, break_on_hyphens=True) or [name]
    if len(lines) <= rows:
        return "\n".join(lines), _TYPE
    return name, max(_TYPE * letters / len(name), 4.5)


def _colour(taxonomy: Taxonomy, node: Node) -> tuple[float, float, float]:
    """A hue for each group of the second level, near to its neighbours', paler downwards."""
    tops = [n.path for n in taxonomy.nodes if n.level == 1 or (n.leaf and n.level == 0)]
    above = [place for place, path in enumerate(tops) if path[: len(node.path)] == node.path[:2]]
    hue = sum(above) / len(above) / len(tops)
    return colorsys.hls_to_rgb(hue, min(0.72 + 0.055 * node.level, 0.94), 0.6)
