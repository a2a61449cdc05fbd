"""Draw a taxonomy as boxes, with the top level on the left and the classes on the right.

The height of a box is proportional to the number of classes below its node. A large tree is split
into blocks that are placed side by side.
"""

from __future__ import annotations

import colorsys
import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.base.errors import FormatError
from toolkit.io.atomic import replacing
from toolkit.semantics.taxonomy import Node, Taxonomy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUFFIXES = (".png", ".svg", ".pdf")

# Lengths in inches, font sizes in points.
_ROW = 0.155
_FONT_SIZE = 7.0
_LETTER = 0.52 * _FONT_SIZE / 72  # average width of a letter
_MIN_COLUMN, _MAX_COLUMN = 0.6, 1.5  # width of a level's column
_GAP = 0.3  # between blocks
_MARGIN, _HEADER = 0.15, 0.6
_ASPECT_RATIO = 1.5  # target width / height of the figure


@dataclass(frozen=True)
class _Box:
    """The part of a node in one block: half-open ranges of rows and columns."""

    node: Node
    rows: tuple[int, int]
    columns: tuple[int, int]


def draw_taxonomy(taxonomy: Taxonomy, path: str | Path, dpi: int = 120) -> None:
    """Write a drawing of the tree.

    Args:
        path: file name with suffix .png, .svg or .pdf.
        dpi: resolution of a PNG in dots per inch.

    Raises:
        FormatError: the suffix is not supported.
        RunFolderError: the file cannot be written.
    """
    # pyplot is not used because it keeps figures and settings in global state.
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise FormatError(f"{path}: a tree can be drawn as {', '.join(SUFFIXES)}")
    order = [n.class_ids[0] for n in taxonomy.nodes if n.leaf]
    columns = _column_edges(taxonomy)
    rows = _rows_per_block(len(order), columns[-1])
    blocks = [order[start : start + rows] for start in range(0, len(order), rows)]
    width = len(blocks) * (columns[-1] + _GAP) - _GAP + 2 * _MARGIN
    width = max(width, len(str(taxonomy)) * 1.6 * _LETTER + 2 * _MARGIN)
    height = rows * _ROW + _HEADER + _MARGIN
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    axes.text(_MARGIN, 0.24, str(taxonomy), fontsize=1.3 * _FONT_SIZE, weight="bold", va="center")
    for number, block in enumerate(blocks):
        left = _MARGIN + number * (columns[-1] + _GAP)
        edges = [left + edge for edge in columns]
        for level, name in enumerate(taxonomy.levels):
            axes.text(edges[level] + 0.03, 0.5, name, fontsize=_FONT_SIZE, color="0.4", va="center")
        for box in _boxes(taxonomy, block):
            _draw(axes, box, edges, _colour(taxonomy, box.node))
    # Reproducible files: no dates, no version names, and a fixed salt for the SVG's identifiers.
    metadata = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with replacing(path) as temporary, rc_context({"svg.hashsalt": "semsplat"}):
        figure.savefig(temporary, dpi=dpi, metadata=metadata[path.suffix])


def _column_edges(taxonomy: Taxonomy) -> list[float]:
    """Return the left edges of the levels' columns and the right edge of the last."""
    edges = [0.0]
    for level in range(taxonomy.depth):
        names = [n.name for n in taxonomy.nodes if n.level == level]
        longest = max(map(len, names)) * _LETTER + 0.1
        edges.append(edges[-1] + min(max(longest, _MIN_COLUMN), _MAX_COLUMN))
    return edges


def _rows_per_block(count: int, width: float) -> int:
    """Return the number of rows that approximates the target aspect ratio."""
    blocks = math.sqrt(_ASPECT_RATIO * count * _ROW / (width + _GAP))
    return math.ceil(count / max(1, round(blocks)))


def _boxes(taxonomy: Taxonomy, block: Sequence[int]) -> Iterator[_Box]:
    """Yield the boxes of the classes of a block and of the nodes above them."""
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
    top, bottom = (_HEADER + row * _ROW for row in box.rows)
    axes.add_patch(
        Rectangle((left, top), right - left, bottom - top, facecolor=colour, edgecolor="white")
    )
    text, size = _fitted(box.node.name, right - left, box.rows[1] - box.rows[0])
    x, y = left + 0.04, (top + bottom) / 2
    axes.text(x, y, text, fontsize=size, va="center_baseline", linespacing=1.1)


def _fitted(name: str, width: float, rows: int) -> tuple[str, float]:
    """Wrap a name to the rows of its box, or return it on one line in a smaller font size."""
    letters = max(int((width - 0.08) / _LETTER), 1)
    lines = textwrap.wrap(name, letters, break_on_hyphens=True) or [name]
    if len(lines) <= rows:
        return "\n".join(lines), _FONT_SIZE
    return name, max(_FONT_SIZE * letters / len(name), 4.5)


def _colour(taxonomy: Taxonomy, node: Node) -> tuple[float, float, float]:
    """Return a hue per group of the second level, lighter with increasing level."""
    tops = [n.path for n in taxonomy.nodes if n.level == 1 or (n.leaf and n.level == 0)]
    above = [index for index, path in enumerate(tops) if path[: len(node.path)] == node.path[:2]]
    hue = sum(above) / len(above) / len(tops)
    return colorsys.hls_to_rgb(hue, min(0.72 + 0.055 * node.level, 0.94), 0.6)
