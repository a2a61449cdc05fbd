"""The submaps of a run as a graph: overlaps and loop edges, drawn from above as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.geometry.frustum import Frustum, contained_fraction

Array = NDArray[np.float64]

# Smaller overlaps are not drawn.
MIN_OVERLAP = 0.05
_WIDTH, _HEIGHT, _MARGIN, _RADIUS = 640.0, 400.0, 46.0, 15.0
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


def submap_graph_svg(graph: SubmapGraph) -> str:
    """Draw the graph; wider lines are larger overlaps, dashed lines have a loop edge."""
    positions_m = np.array([submap.position_m for submap in graph.submaps])
    scale, offset = _scale(np.concatenate([positions_m, graph.path_m]))

    def pixels(points_m: Array) -> Array:
        # Forward is up in the drawing.
        return points_m * np.array([scale, -scale]) + offset

    places = _apart(pixels(positions_m))
    at = {submap.number: place for submap, place in zip(graph.submaps, places, strict=True)}
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels(graph.path_m))
    body = [f'<polyline class="path" points="{path}"/>']
    body += [_overlap_line(link, at) for link in graph.links]
    body += [f'<line class="loop" {_ends(link, at)}/>' for link in graph.links if link.loop]
    for submap in graph.submaps:
        x, y = at[submap.number]
        body.append(
            f'<circle class="node" cx="{x:.1f}" cy="{y:.1f}" r="{_RADIUS}">'
            f"<title>submap {submap.number}: {submap.keyframes} keyframes</title></circle>"
            f'<text class="mid number" x="{x:.1f}" y="{y + 4:.1f}">{submap.number}</text>'
        )
    return (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" '
        f'aria-label="overlaps and loops of the submaps">{"".join(body)}</svg>'
    )


def _overlap_line(link: SubmapLink, at: dict[int, Array]) -> str:
    title = f"submaps {link.first} and {link.second}: {100 * link.overlap:.0f} % overlap"
    title += ", loop edge" * link.loop
    width = max(1.0, _MAX_WIDTH * link.overlap)
    return (
        f'<line class="overlap" {_ends(link, at)} stroke-width="{width:.1f}">'
        f"<title>{title}</title></line>"
    )


def _ends(link: SubmapLink, at: dict[int, Array]) -> str:
    (x1, y1), (x2, y2) = at[link.first], at[link.second]
    return f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'


def _scale(points_m: Array) -> tuple[float, Array]:
    """Return the scale and offset that fit points [N, 2] into the drawing, with y upwards."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    room = np.array([_WIDTH, _HEIGHT]) - 2 * _MARGIN
    scale = float((room / np.maximum(high - low, 1e-3)).min())
    centre = (low + high) / 2
    return scale, np.array([_WIDTH / 2 - scale * centre[0], _HEIGHT / 2 + scale * centre[1]])


def _apart(places: Array) -> Array:
    """Move circles [N, 2] apart that would cover each other."""
    places = places.copy()
    # Circles at one place need directions in which to move; these are fixed by their number.
    angles = 2.4 * np.arange(len(places))
    places += 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for _ in range(_MOVES):
        offsets = places[:, None] - places[None]
        distances = np.linalg.norm(offsets, axis=2) + np.eye(len(places)) * 1e9
        close = distances < _SPACING
        if not close.any():
            break
        push = np.where(close, (_SPACING - distances) / distances, 0.0)[..., None] * offsets
        places += 0.3 * push.sum(axis=1)
        places = np.clip(places, _RADIUS + 2, [_WIDTH - _RADIUS - 2, _HEIGHT - _RADIUS - 2])
    return places
