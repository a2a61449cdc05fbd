"""The submaps of a run as a graph: overlaps and loop edges, drawn from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.frustum import Frustum, contained_fraction
from toolkit.runs.evaluation.charts import colour, drawing, tooltip

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Plot

Array = NDArray[np.float64]

# Smaller overlaps are not drawn.
MIN_OVERLAP = 0.05
# Pixels of the drawing within its margins, and the radius of the circle of a submap.
_AREA, _RADIUS = np.array([548.0, 308.0]), 15.0
# Circles of submaps in one room are moved apart until they are this far from each other.
_SPACING, _MOVES = 2.6 * _RADIUS, 200
_MAX_WIDTH = 9.0


@dataclass(frozen=True)
class SubmapViews:
    """A submap as its keyframes observe it.

    Attributes:
        number: of the submap.
        keyframes: number of its keyframes.
        position_m: [2] mean position of its cameras from above (x, z).
        points_m: [P, 3] observed points in the map.
        frusta: views of some keyframes.
    """

    number: int
    keyframes: int
    position_m: Array
    points_m: Array
    frusta: Sequence[Frustum]


@dataclass(frozen=True)
class SubmapLink:
    """Two submaps that overlap or have a loop edge; overlap in [0, 1]."""

    first: int
    second: int
    overlap: float
    loop: bool


@dataclass(frozen=True)
class SubmapGraph:
    """Submaps, their links, and the path of the camera [N, 2] from above (x, z)."""

    submaps: Sequence[SubmapViews]
    links: Sequence[SubmapLink]
    path_m: Array


def submap_links(
    submaps: Sequence[SubmapViews], loops: Sequence[tuple[int, int]]
) -> list[SubmapLink]:
    """Return the links of all pairs of submaps that overlap or have a loop edge.

    The overlap of two submaps is the larger of the fractions of observed points of one that lie in
    the views of the other. Walls between them are not considered.

    Args:
        loops: pairs of numbers of submaps.
    """
    pairs = {(min(pair), max(pair)) for pair in loops}
    links = []
    for i, first in enumerate(submaps):
        for second in submaps[i + 1 :]:
            overlap = max(
                contained_fraction(first.points_m, second.frusta),
                contained_fraction(second.points_m, first.frusta),
            )
            numbers = (min(first.number, second.number), max(first.number, second.number))
            if overlap >= MIN_OVERLAP or numbers in pairs:
                links.append(SubmapLink(*numbers, overlap, numbers in pairs))
    return links


def observed_from(points_camera_m: Array, T_map_camera: Array) -> Array:
    """Return the finite points of [P, 3] in the map."""
    finite = points_camera_m[np.isfinite(points_camera_m).all(axis=1)]
    return se3.transform_points(T_map_camera, finite)


def submap_graph_chart(graph: SubmapGraph) -> Markup:
    """Draw the graph; wider lines are larger overlaps, dashed lines have a loop edge."""
    positions_m = np.array([submap.position_m for submap in graph.submaps])
    extent_m = np.ptp(np.concatenate([positions_m, graph.path_m]), axis=0)
    m_per_pixel = float((np.maximum(extent_m, 1e-3) / _AREA).max())
    places_m = m_per_pixel * _apart(positions_m / m_per_pixel)
    at = {submap.number: place for submap, place in zip(graph.submaps, places_m, strict=True)}

    def draw(plot: Plot) -> None:
        x, y = graph.path_m.T
        plot.plot(x, y, color=colour("truth"), linewidth=1, alpha=0.7, label="path from above")
        for link in graph.links:
            _draw_link(plot, link, np.stack([at[link.first], at[link.second]], axis=1))
        circle: dict[str, Any] = {"markersize": 2 * _RADIUS, "color": colour("estimate")}
        digits: dict[str, Any] = {"color": colour("ink"), "weight": "bold"}
        digits |= {"ha": "center", "va": "center_baseline"}
        for submap in graph.submaps:
            gid = tooltip(f"submap {submap.number}: {submap.keyframes} keyframes")
            x, y = at[submap.number]
            plot.plot(x, y, "o", gid=gid, **circle)
            plot.text(x, y, str(submap.number), gid=gid, **digits)
        plot.set_aspect("equal", adjustable="datalim")
        plot.margins(0.15)
        plot.axis("off")

    return drawing(draw, "overlaps and loops of the submaps")


def _draw_link(plot: Plot, link: SubmapLink, ends_m: Array) -> None:
    title = f"submaps {link.first} and {link.second}: {100 * link.overlap:.0f} % overlap"
    plot.plot(
        *ends_m,
        color=colour("estimate"),
        alpha=0.35,
        linewidth=max(1.0, _MAX_WIDTH * link.overlap),
        label="overlap, wider is more",
        gid=tooltip(title + ", loop edge" * link.loop),
    )
    if link.loop:
        plot.plot(*ends_m, color=colour("second"), dashes=(2.5, 2), label="loop edge")


def _apart(places: Array) -> Array:
    """Move circles [N, 2], in pixels, apart that would cover each other."""
    # Circles at one place need directions in which to move; these are fixed by their number.
    angles = 2.4 * np.arange(len(places))
    places = places + 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for _ in range(_MOVES):
        offsets = places[:, None] - places[None]
        distances = np.linalg.norm(offsets, axis=2) + np.eye(len(places)) * 1e9
        close = distances < _SPACING
        if not close.any():
            break
        push = np.where(close, (_SPACING - distances) / distances, 0.0)[..., None] * offsets
        places += 0.3 * push.sum(axis=1)
    return places
