"""Small objects, and their arrangement on surfaces and shelves."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from data_tools.training_rooms.solids import (
    Piece,
    Solid,
    box,
    cylinder,
    lathe,
    placed,
    rounded,
    sheet,
    tilted,
)


def monitor(rng: Generator) -> Piece:
    """A screen on a foot; a television if it is large."""
    width = rng.uniform(0.4, 0.7) if rng.random() < 0.75 else rng.uniform(0.8, 1.4)
    height = width * rng.uniform(0.55, 0.65)
    base = rng.uniform(0.04, 0.16)
    return [
        box("screen", (width, rng.uniform(0.015, 0.06), height), (0.0, 0.0, base), dark=True),
        box("screen", (0.06, 0.04, base + 0.1), (0.0, 0.04, 0.0)),
        box("screen", (width * 0.45, 0.2, 0.015)),
    ]


def laptop(rng: Generator) -> Piece:
    """An open laptop."""
    width, depth = rng.uniform(0.3, 0.38), rng.uniform(0.2, 0.26)
    lid = [box("screen", (width, 0.01, depth), dark=True)]
    base = box("screen", (width, depth, 0.02), (0.0, -depth / 2, 0.0))
    return [base, *tilted(lid, -rng.uniform(0.1, 0.5), (0.0, 0.0, 0.02))]


def cushion(rng: Generator) -> Piece:
    """A cushion that lies flat."""
    side = rng.uniform(0.35, 0.55)
    size = (side, side * rng.uniform(0.6, 1.0), rng.uniform(0.1, 0.2))
    return [rounded("cushion", size, power=3.0)]


def shade(rng: Generator, radius: float) -> Solid:
    """The shade of a lamp, its lower edge at z = 0."""
    height = rng.uniform(0.15, 0.35)
    if rng.random() < 0.2:
        return rounded("lamp", (2 * radius, 2 * radius, 2 * radius))
    top = radius * rng.uniform(0.4, 1.0)
    return lathe("lamp", [(radius, 0.0), (top, height), (0.0, height)], (0.0, 0.0, 0.0))


def table_lamp(rng: Generator) -> Piece:
    """A lamp for a table."""
    height = rng.uniform(0.2, 0.4)
    foot = [
        cylinder("lamp", rng.uniform(0.05, 0.1), 0.02),
        cylinder("lamp", rng.uniform(0.01, 0.05), height),
    ]
    return foot + placed([shade(rng, rng.uniform(0.07, 0.17))], (0.0, 0.0, height - 0.05))


def potted(rng: Generator, height: float) -> Piece:
    """A plant: a pot and leaves of random attitude."""
    pot_height = height * rng.uniform(0.15, 0.55)
    radius = height * rng.uniform(0.1, 0.25)
    profile = [(0.0, 0.0), (rng.uniform(0.6, 1.0) * radius, 0.0), (radius, pot_height)]
    # Four sides make it a square one.
    sides = 4 if rng.random() < 0.4 else 12
    pot = lathe("plant", [*profile, (0.0, pot_height * 0.9)], (0.0, 0.0, 0.0), sides)
    piece = [pot, cylinder("plant", 0.01 + 0.01 * height, height * 0.6)]
    spread = height * rng.uniform(0.2, 0.45)
    long, wide = height * rng.uniform(0.12, 0.3), height * rng.uniform(0.03, 0.12)
    half = np.array([[0.5, 0.0, 0.0], [0.7, 1.0, 0.3], [0.1, 2.0, 0.0]])
    leaf = np.stack([half * [-1.0, 1.0, 1.0], half], axis=1) * [wide, long / 2, long / 2]
    for _ in range(int(rng.integers(8, 26))):
        outward = rng.normal(0, 0.5, 2) * spread
        at = (*outward, pot_height + (height - pot_height) * rng.beta(2.0, 1.5))
        lifted = tilted([sheet("plant", leaf)], rng.uniform(-0.6, 1.2))
        piece += placed(lifted, at, rng.uniform(0, 2 * np.pi))
    return piece


def small_thing(rng: Generator, largest_m: float = 0.35) -> Piece:
    """A bottle, bowl, box, stack of books, machine, plant or lamp."""
    kind = rng.choice(
        ["bottle", "bowl", "box", "books", "blob", "machine", "plant", "lamp"],
        p=[0.2, 0.15, 0.15, 0.15, 0.15, 0.1, 0.05, 0.05],
    )
    if kind == "bottle":
        radius, height = rng.uniform(0.025, 0.06), rng.uniform(0.08, largest_m)
        profile = [(0.0, 0.0), (radius, 0.0), (radius, 0.65 * height), (0.4 * radius, height)]
        return [lathe("thing", [*profile, (0.0, height)], (0.0, 0.0, 0.0), 10)]
    if kind == "bowl":
        radius = rng.uniform(0.06, 0.16)
        return [lathe("thing", [(radius / 2, 0.0), (radius, 0.6 * radius)], (0.0, 0.0, 0.0), 12)]
    if kind == "box":
        return [box("box", tuple(rng.uniform(0.08, largest_m, 3)))]
    if kind == "books":
        thick = rng.uniform(0.02, 0.05, int(rng.integers(1, 6)))
        heights = np.cumsum(thick) - thick
        books: Piece = []
        for base, height in zip(heights, thick, strict=True):
            size = (rng.uniform(0.15, 0.24), rng.uniform(0.2, 0.3), float(height))
            books += placed([box("thing", size)], (0.0, 0.0, float(base)), rng.normal(0, 0.15))
        return books
    if kind == "machine":
        height = rng.uniform(0.15, 0.35)
        body = box("appliance", (rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.35), height))
        return [body, cylinder("appliance", 0.05, height * 1.1)]
    if kind == "plant":
        return potted(rng, rng.uniform(0.2, 0.5))
    if kind == "lamp":
        return table_lamp(rng)
    return [rounded("thing", tuple(rng.uniform(0.06, largest_m, 3)), power=rng.uniform(1.5, 6))]


def scattered(rng: Generator, size_m: tuple[float, float], height: float, count: int) -> Piece:
    """Things on a surface whose back is at y = 0; they may touch each other."""
    width, depth = size_m
    piece: Piece = []
    for _ in range(count):
        x = rng.uniform(-0.42, 0.42) * width
        y = -depth * rng.uniform(0.12, 0.85)
        piece += placed(small_thing(rng), (x, y, height), rng.uniform(0, 2 * np.pi))
    return piece


def row(
    rng: Generator, width: float, depth: float, base: float, height: float, filling: float
) -> Piece:
    """Books and things on a board of a shelf, from the left."""
    piece: Piece = []
    x, end = -width / 2, width / 2
    if height < 0.1:
        return piece
    while x < end:
        if rng.random() > filling:
            x += rng.uniform(0.05, 0.3)
            continue
        if rng.random() < 0.75:
            # Books are blocks: their single spines are below the resolution.
            block = rng.uniform(0.03, 0.25)
            tall = height * rng.uniform(0.5, 0.95)
            deep = depth * rng.uniform(0.5, 0.9)
            at = (x + block / 2, -deep / 2 - 0.02, base)
            piece.append(box("thing", (block, deep, tall), at))
            x += block
        else:
            thing = small_thing(rng, min(0.3, height * 0.9))
            piece += placed(thing, (x + 0.12, -depth / 2, base))
            x += 0.24
    return piece
