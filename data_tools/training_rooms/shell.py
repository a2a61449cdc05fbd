"""Floors, walls with doors and windows, ceilings, and what hangs on the walls.

A wall stands along the x axis from 0 to its length with the room towards -y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from data_tools.training_rooms.solids import Piece, box, placed, sheet, tilted

# Thickness of walls; what lies behind their openings is beyond that.
THICKNESS_M = 0.25
# Distance of the walls of the neighbouring rooms, which are seen through doors.
_BEYOND_M = 1.6


@dataclass(frozen=True)
class Opening:
    """A door or a window in a wall.

    Attributes:
        name: "door" or "window". left_m, right_m: along the wall. base_m, top_m: heights.
    """

    name: str
    left_m: float
    right_m: float
    base_m: float
    top_m: float

    @property
    def middle_m(self) -> float:
        return (self.left_m + self.right_m) / 2

    @property
    def size_m(self) -> tuple[float, float]:
        return self.right_m - self.left_m, self.top_m - self.base_m


def wall(rng: Generator, length: float, height: float, openings: list[Opening]) -> Piece:
    """A wall with its openings and their doors, windows, blinds and curtains."""
    piece: Piece = []
    at = 0.0
    for opening in sorted(openings, key=lambda o: o.left_m):
        piece += _block(at, opening.left_m, 0.0, height)
        piece += _block(opening.left_m, opening.right_m, 0.0, opening.base_m)
        piece += _block(opening.left_m, opening.right_m, opening.top_m, height)
        piece += door(rng, opening) if opening.name == "door" else window(rng, opening)
        at = opening.right_m
    return piece + _block(at, length, 0.0, height) + _skirting(rng, length, openings)


def _block(left: float, right: float, base: float, top: float) -> Piece:
    if right - left < 1e-3 or top - base < 1e-3:
        return []
    size = (right - left, THICKNESS_M, top - base)
    return [box("wall", size, ((left + right) / 2, THICKNESS_M / 2, base))]


def _skirting(rng: Generator, length: float, openings: list[Opening]) -> Piece:
    if rng.random() < 0.4 or any(o.name == "door" for o in openings):
        return []
    return [box("wall", (length, 0.015, 0.08), (length / 2, -0.0075, 0.0))]


def door(rng: Generator, opening: Opening) -> Piece:
    """A door leaf in its frame, shut or open, or only the frame of a passage."""
    width, height = opening.size_m
    frame = rng.uniform(0.04, 0.1)
    proud = rng.uniform(0.005, 0.03)
    depth = THICKNESS_M + 2 * proud
    piece: Piece = []
    for x in (opening.left_m + frame / 2, opening.right_m - frame / 2):
        piece.append(box("door", (frame, depth, height), (x, THICKNESS_M / 2, 0.0)))
    piece.append(
        box("door", (width, depth, frame), (opening.middle_m, THICKNESS_M / 2, height - frame))
    )
    piece.append(box("floor", (width, THICKNESS_M, 0.01), (opening.middle_m, 0.125, -0.01)))
    inner = width - 2 * frame
    leaf = _leaf(rng, inner, height - frame)
    kind = rng.choice(["shut", "open", "none"], p=[0.7, 0.22, 0.08])
    inset = rng.uniform(-proud, 0.15)
    if kind == "shut":
        piece += placed(leaf, (opening.middle_m, inset, 0.0))
    elif kind == "open":
        swing = rng.uniform(0.3, 1.9) * rng.choice([-1.0, 1.0])
        hinged = placed(leaf, (inner / 2, 0.0, 0.0))
        at = (opening.left_m + frame, inset if swing < 0 else THICKNESS_M, 0.0)
        piece += placed(hinged, at, swing)
    return piece


def _leaf(rng: Generator, width: float, height: float) -> Piece:
    leaf = [box("door", (width, 0.04, height), (0.0, 0.02, 0.0))]
    side = rng.choice([-1.0, 1.0]) * (width / 2 - 0.08)
    leaf.append(box("door", (0.12, 0.05, 0.02), (side * 0.9, -0.03, 1.02)))
    if rng.random() < 0.4:
        rows = int(rng.integers(1, 4))
        for k in range(rows):
            size = (width * 0.7, 0.012, height * 0.75 / rows)
            leaf.append(box("door", size, (0.0, -0.006, height * (0.1 + 0.85 * k / rows))))
    if rng.random() < 0.15:
        size = (width * 0.6, 0.045, height * 0.35)
        leaf.append(box("door", size, (0.0, 0.02, height * 0.55), dark=True))
    return leaf


def window(rng: Generator, opening: Opening) -> Piece:
    """A window with its frame, sill, panes, and often blinds or curtains."""
    width, height = opening.size_m
    frame, inset = rng.uniform(0.04, 0.09), rng.uniform(0.02, 0.2)
    x, base = opening.middle_m, opening.base_m
    piece = [
        box("window", (width, 0.05, frame), (x, inset + 0.025, base)),
        box("window", (width, 0.05, frame), (x, inset + 0.025, opening.top_m - frame)),
    ]
    for bar in np.linspace(opening.left_m + frame / 2, opening.right_m - frame / 2, 2 + int(width)):
        piece.append(box("window", (frame, 0.05, height), (float(bar), inset + 0.025, base)))
    y = inset + 0.03
    pane = [[[opening.left_m, y, z], [opening.right_m, y, z]] for z in (base, opening.top_m)]
    piece.append(sheet("window", np.array(pane), dark=True))
    if rng.random() < 0.7:
        reach = rng.uniform(0.02, 0.25)
        size = (width + 0.1, reach + inset, 0.03)
        piece.append(box("window", size, (x, (inset - reach) / 2, base - 0.03)))
    kind = rng.choice(["none", "blinds", "roller", "curtains"], p=[0.4, 0.25, 0.1, 0.25])
    drop = height * rng.uniform(0.15, 1.0)
    if kind == "blinds":
        piece += _slats(rng, opening, drop, inset)
    elif kind == "roller":
        y = rng.uniform(-0.06, inset)
        piece.append(box("blinds", (width, 0.01, drop), (x, y, opening.top_m - drop)))
        piece.append(box("blinds", (width, 0.07, 0.07), (x, y, opening.top_m - 0.07)))
    elif kind == "curtains":
        piece += _curtains(rng, opening)
    return piece


def _slats(rng: Generator, opening: Opening, drop: float, inset: float) -> Piece:
    width = opening.size_m[0]
    upright = rng.random() < 0.3
    y = rng.uniform(-0.08, inset - 0.02)
    if upright:
        xs = np.arange(opening.left_m, opening.right_m, 0.1)
        slat = [box("blinds", (0.09, 0.004, drop), (0.0, 0.0, opening.top_m - drop))]
        turn = rng.uniform(-0.9, 0.9)
        return [s for x in xs for s in placed(slat, (float(x) + 0.05, y, 0.0), turn)]
    spacing = rng.uniform(0.03, 0.06)
    slat = tilted([box("blinds", (width, spacing * 0.95, 0.003))], rng.uniform(-1.2, 1.2))
    heights = np.arange(opening.top_m - drop, opening.top_m, spacing)
    return [s for z in heights for s in placed(slat, (opening.middle_m, y, float(z)))]


def _curtains(rng: Generator, opening: Opening) -> Piece:
    top = opening.top_m + rng.uniform(0.0, 0.3)
    base = rng.uniform(0.0, 0.1) if rng.random() < 0.6 else max(0.0, opening.base_m - 0.2)
    width, _ = opening.size_m
    drawn = rng.uniform(0.15, 0.5) * width
    pieces: Piece = []
    for left in (opening.left_m - 0.2, opening.right_m + 0.2 - drawn):
        x = np.linspace(left, left + drawn, 24)
        wave = rng.uniform(0.02, 0.06) * np.sin(x * 2 * np.pi / rng.uniform(0.08, 0.2))
        y = wave - rng.uniform(0.06, 0.12)
        rows = [np.column_stack([x, y, np.full_like(x, z)]) for z in (top, base)]
        pieces.append(sheet("blinds", np.stack(rows)))
    return pieces


def hangings(rng: Generator, length: float, height: float, openings: list[Opening]) -> Piece:
    """Pictures, screens, boards and lamps on the free parts of a wall."""
    piece: Piece = []
    for _ in range(rng.poisson(0.35 * length)):
        kind = rng.choice(
            ["picture", "screen", "board", "lamp", "clock"], p=[0.6, 0.15, 0.1, 0.1, 0.05]
        )
        width, tall = rng.uniform(0.25, 1.1), rng.uniform(0.25, 0.9)
        if kind == "board":
            width, tall = rng.uniform(1.0, 2.4), rng.uniform(0.9, 1.2)
        elif kind == "screen":
            width, tall = rng.uniform(0.7, 2.0), rng.uniform(0.4, 0.8)
        x = rng.uniform(width / 2, max(length - width / 2, width / 2 + 0.01))
        taken = any(o.left_m - width / 2 < x < o.right_m + width / 2 for o in openings)
        base = rng.uniform(1.0, max(1.05, height - tall - 0.2))
        if taken or base + tall > height:
            continue
        if kind == "lamp":
            piece.append(box("lamp", (0.15, 0.12, 0.2), (x, -0.06, 1.8)))
            continue
        thick = rng.uniform(0.03, 0.15) if kind == "screen" else rng.uniform(0.008, 0.05)
        name = "screen" if kind == "screen" else "picture"
        size = (width, thick, tall)
        piece.append(box(name, size, (x, -thick / 2, base), dark=kind == "screen"))
    return piece


def ceiling_lamps(rng: Generator, size_m: tuple[float, float], height: float) -> Piece:
    """Pendants, panels or round lamps below the ceiling, or beams."""
    piece: Piece = []
    kind = rng.choice(["pendant", "panel", "none"])
    for _ in range(rng.integers(1, 5)):
        x, y = rng.uniform(0.15, 0.85, 2) * size_m
        if kind == "pendant":
            drop, radius = rng.uniform(0.2, 1.0), rng.uniform(0.1, 0.35)
            piece.append(box("lamp", (0.01, 0.01, drop), (x, y, height - drop)))
            piece.append(box("lamp", (2 * radius, 2 * radius, 0.2), (x, y, height - drop - 0.2)))
        elif kind == "panel":
            size = (rng.uniform(0.3, 1.3), rng.uniform(0.3, 0.6), rng.uniform(0.02, 0.1))
            piece.append(box("lamp", size, (x, y, height - size[2])))
    if rng.random() < 0.15:
        deep = rng.uniform(0.1, 0.35)
        for y in np.arange(0.8, size_m[1], rng.uniform(0.8, 2.5)):
            size = (size_m[0], 0.2, deep)
            piece.append(box("ceiling", size, (size_m[0] / 2, float(y), height - deep)))
    return piece


def surroundings(size_m: tuple[float, float], height: float) -> Piece:
    """The floor and the ceiling, which reach below walls, and the walls of the next rooms."""
    width, depth = size_m
    out = _BEYOND_M + THICKNESS_M
    span = (width + 2 * out, depth + 2 * out, 0.1)
    centre = (width / 2, depth / 2)
    piece = [
        box("floor", span, (*centre, -0.1)),
        box("ceiling", span, (*centre, height)),
    ]
    for x in (-out, width + out):
        piece.append(box("wall", (0.05, span[1], height), (x, depth / 2, 0.0)))
    for y in (-out, depth + out):
        piece.append(box("wall", (span[0], 0.05, height), (width / 2, y, 0.0)))
    return piece


def openings_of(
    rng: Generator, length: float, height: float, doors: int, windows: int
) -> list[Opening]:
    """Doors and windows at random places of a wall that do not overlap."""
    found: list[Opening] = []
    for name in ["door"] * doors + ["window"] * windows:
        if name == "door":
            width = rng.uniform(0.75, 1.0) * (1.8 if rng.random() < 0.1 else 1.0)
            base, top = 0.0, rng.uniform(1.95, 2.2)
        else:
            width = rng.uniform(0.6, 2.4)
            base = 0.02 if rng.random() < 0.12 else rng.uniform(0.5, 1.1)
            top = rng.uniform(base + 0.7, height - 0.12)
        if width > length - 0.3:
            continue
        left = rng.uniform(0.12, length - width - 0.12)
        new = Opening(name, left, left + width, base, min(top, height - 0.08))
        if all(new.right_m < o.left_m - 0.1 or new.left_m > o.right_m + 0.1 for o in found):
            found.append(new)
    return found
