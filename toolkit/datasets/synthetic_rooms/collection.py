"""A room with many classes: open shelves along the walls, filled with small objects.

The objects are words of the built-in vocabulary, which gives their size and shape. All objects of
a class look the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.furniture import CLOTHS, DARK, PALE, WOODS, Workshop, piece
from toolkit.datasets.synthetic_rooms.parts import Part, moved
from toolkit.datasets.synthetic_rooms.patches import (
    TexturedPatch,
    box,
    cushion,
    cylinder,
    disk,
    ellipsoid,
    lathe,
    placement,
)
from toolkit.datasets.synthetic_rooms.shell import SIDES, RoomPlan, Side
from toolkit.semantics.taxonomy_building.vocabulary import Entry, built_in
from toolkit.semantics.taxonomy_parsing import folded

# Classes of the room itself; some seeds have blinds, the others curtains.
SHELL_CLASSES = ("wall", "floor", "ceiling", "door", "window", "curtain", "blinds", "shelf")
# The shelves of the default room have more than 600 compartments.
MIN_CLASSES, MAX_CLASSES = 20, 500

_DEPTH_M, _BOARD_M = 0.26, 0.02
_PITCH_M, _FIRST_M, _ROWS = 0.3, 0.1, 7
_COMPARTMENT_M = 0.16
_CORNER_M = 0.32  # distance of shelves from the corners of the room
_WINDOW_MARGIN_M, _DOOR_MARGIN_M = 0.3, 0.1
_LARGEST_WORD_M = 0.35  # no car on a shelf
_WIDEST_M, _LOWEST_M, _HIGHEST_M = 0.125, 0.09, 0.24

# From the longest side and the width, metres, to surfaces.
_Shape = Callable[[float, float], list[TexturedPatch]]


def class_names(count: int) -> tuple[str, ...]:
    """Return `count` class names: those of the room, then small objects of all functions."""
    reserved = {folded(name) for name in SHELL_CLASSES}
    words = [
        entry.word
        for entry in built_in()
        if entry.size_m <= _LARGEST_WORD_M and folded(entry.word) not in reserved
    ]
    # The vocabulary is sorted by function.
    chosen = np.linspace(0, len(words) - 1, count - len(SHELL_CLASSES)).astype(int)
    return (*SHELL_CLASSES, *(words[number] for number in chosen))


def shelves_of_objects(plan: RoomPlan, shop: Workshop, names: Sequence[str]) -> list[Part]:
    """Fill the free walls of a room with shelves, and each compartment with an object.

    Args:
        plan: the room.
        shop: source of randomness.
        names: class names of `class_names`; every object class has a compartment at least.

    Raises:
        ValueError: there are more object classes than compartments.
    """
    parts: list[Part] = []
    compartments: list[NDArray[np.float64]] = []
    for side, start, end in _free_walls(plan):
        columns = int((end - start - _BOARD_M) / _COMPARTMENT_M)
        T = plan.on_wall(side, (start + end) / 2)
        parts += moved(_open_shelf(shop, columns * _COMPARTMENT_M), T)
        for row in range(_ROWS):
            z = _FIRST_M + _PITCH_M * row + _BOARD_M
            for column in range(columns):
                x = (column - (columns - 1) / 2) * _COMPARTMENT_M
                compartments.append(T @ placement(x, -_DEPTH_M / 2, z))
    objects = [name for name in names if name not in SHELL_CLASSES]
    if len(objects) > len(compartments):
        raise ValueError(f"{len(objects)} objects do not fit into {len(compartments)} compartments")
    made = [_object(shop, name) for name in objects]
    for number, place in enumerate(shop.rng.permutation(len(compartments))):
        turn = placement(0.0, 0.0, 0.0, shop.rng.uniform(-0.3, 0.3))
        copy = shop.as_objects(made[number % len(made)])
        parts += moved(copy, compartments[place] @ turn)
    return parts


def _free_walls(plan: RoomPlan) -> Iterator[tuple[Side, float, float]]:
    """Yield the sections of the walls without openings: side, start and end in metres."""
    for side in SIDES:
        stops = [_CORNER_M, plan.wall_length_m(side) - _CORNER_M]
        for opening in plan.openings:
            if opening.side == side:
                left, _, right, _ = opening.extent_m
                margin = _WINDOW_MARGIN_M if opening.kind == "window" else _DOOR_MARGIN_M
                stops += [left - margin, right + margin]
        for start, end in list(pairwise(sorted(stops)))[::2]:
            if end - start > 3 * _COMPARTMENT_M:
                yield side, start, end


@piece
def _open_shelf(shop: Workshop, width: float) -> list[Part]:
    """An empty shelf with its back at y = 0, centred at x = 0."""
    height = _FIRST_M + _PITCH_M * _ROWS
    body = box((width, 0.012, height), (0.0, -0.006, 0.0))
    for x in (-(width + _BOARD_M) / 2, (width + _BOARD_M) / 2):
        body += box((_BOARD_M, _DEPTH_M, height + _BOARD_M), (x, -_DEPTH_M / 2, 0.0))
    for row in range(_ROWS + 1):
        z = _FIRST_M + _PITCH_M * row
        body += box((width, _DEPTH_M - 0.012, _BOARD_M), (0.0, -_DEPTH_M / 2 - 0.006, z))
    return [shop.part("shelf", body, tx.wood(shop.pick(WOODS)))]


@piece
def _object(shop: Workshop, name: str) -> list[Part]:
    """An object with the shape of its word, standing at z = 0 and centred at x = y = 0."""
    entry = built_in().look_up(name)
    high = float(np.clip(entry.size_m, _LOWEST_M, _HIGHEST_M)) * shop.rng.uniform(0.85, 1.0)
    wide = shop.rng.uniform(0.7, 1.0) * _WIDEST_M
    return [shop.part(name, _SHAPES[entry.shape](high, wide), _texture(shop, entry))]


def _texture(shop: Workshop, entry: Entry) -> tx.Texture:
    # Any hue, so that neighbours differ.
    hue, value = shop.rng.uniform(0, 2 * math.pi), shop.rng.uniform(0.35, 0.75)
    phases = hue + np.array([0.0, 2.1, 4.2])
    red, green, blue = np.clip(value * (1.0 + 0.55 * np.cos(phases)), 0.05, 0.95)
    colour = (float(red), float(green), float(blue))
    second = shop.pick((*CLOTHS, PALE, DARK))
    if entry.shape == "soft":
        return tx.plaid(colour, (second, PALE), 0.07)
    choices = (
        tx.banded(colour, second, 0.05),
        tx.stripes(colour, second, 0.05),
        tx.speckled(colour, 0.2),
        tx.weave(colour, 0.02, 0.2),
    )
    return choices[int(shop.rng.integers(len(choices)))]


def _slab(high: float, wide: float) -> list[TexturedPatch]:
    return box((wide, 0.03, high))


def _bar(high: float, wide: float) -> list[TexturedPatch]:
    return box((0.4 * wide, 0.4 * wide, high))


def _tin(high: float, wide: float) -> list[TexturedPatch]:
    return cylinder(0.3 * wide, high)


def _block(high: float, wide: float) -> list[TexturedPatch]:
    return box((wide, 0.8 * wide, 0.6 * high))


def _stand(high: float, wide: float) -> list[TexturedPatch]:
    top = box((wide, 0.8 * wide, 0.2 * high), (0, 0, 0.8 * high))
    return [*cylinder(0.15 * wide, 0.8 * high), *top]


def _ball(high: float, wide: float) -> list[TexturedPatch]:
    radius = wide / 2
    return [ellipsoid((radius, radius, high / 2.2), (0, 0, high / 2.2))]


def _pot(high: float, wide: float) -> list[TexturedPatch]:
    profile = [(0.5 * wide, high), (0.45 * wide, 0.5 * high), (0.3 * wide, 0.0)]
    return [lathe(profile), disk(0.47 * wide, (0, 0, 0.85 * high))]


def _pad(high: float, wide: float) -> list[TexturedPatch]:
    return cushion((wide, 0.9 * wide, 0.6 * high), (0, 0, 0), 3.0)


def _figure(high: float, wide: float) -> list[TexturedPatch]:
    profile = [(0.0, 1.0), (0.35, 0.85), (0.15, 0.65), (0.5, 0.4), (0.25, 0.15), (0.4, 0.0)]
    return [lathe([(radius * wide, z * high) for radius, z in profile])]


# One for each of `vocabulary.SHAPES`.
_SHAPES: dict[str, _Shape] = {
    "flat": _slab,
    "long": _bar,
    "tall": _tin,
    "boxy": _block,
    "legged": _stand,
    "round": _ball,
    "hollow": _pot,
    "soft": _pad,
    "irregular": _figure,
}
