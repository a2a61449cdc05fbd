"""Large furniture. Each piece has its base at z = 0, its back at y = 0 and its front towards -y."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Concatenate, ParamSpec

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import pictures
from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.finishes import Finish
from toolkit.datasets.synthetic_rooms.parts import Part, with_object_ids
from toolkit.datasets.synthetic_rooms.patches import (
    TexturedPatch,
    bent,
    box,
    cushion,
    cylinder,
    disk,
    fine_plate,
    lathe,
)
from toolkit.datasets.synthetic_rooms.textures import Colour, Texture

WOODS: tuple[Colour, ...] = ((0.62, 0.42, 0.25), (0.45, 0.28, 0.17), (0.78, 0.6, 0.4))
CLOTHS: tuple[Colour, ...] = (
    (0.27, 0.42, 0.58), (0.62, 0.3, 0.26), (0.35, 0.5, 0.36),
    (0.7, 0.55, 0.3), (0.5, 0.36, 0.52), (0.3, 0.5, 0.52),
)  # fmt: skip
PALE: Colour = (0.86, 0.84, 0.78)
DARK: Colour = (0.2, 0.2, 0.22)

P = ParamSpec("P")


class Workshop:
    """Creates parts, each with its own random stream."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._objects = 0

    def as_objects(self, parts: list[Part]) -> list[Part]:
        """Give the objects of a piece of furniture numbers that no other piece has."""
        numbered = with_object_ids(parts, self._objects + 1)
        self._objects = max([self._objects, *(part.object_id for part in numbered)])
        return numbered

    def part(
        self,
        name: str,
        patches: list[TexturedPatch],
        texture: Texture,
        glow: float = 0.0,
        finish: Finish = Finish.MATT,
    ) -> Part:
        """Create a part of the class `name`."""
        return Part(name, patches, texture, self.rng.spawn(1)[0], glow, finish)

    def pick(self, choices: tuple[Colour, ...]) -> Colour:
        """Choose one of the colours with a small random variation."""
        base = np.array(choices[self.rng.integers(len(choices))])
        varied = np.clip(base * self.rng.normal(1.0, 0.06, 3), 0.05, 0.95)
        return float(varied[0]), float(varied[1]), float(varied[2])


def piece(
    make: Callable[Concatenate[Workshop, P], list[Part]],
) -> Callable[Concatenate[Workshop, P], list[Part]]:
    """Decorate a function that makes a piece of furniture: its parts know their object."""

    @functools.wraps(make)
    def made(shop: Workshop, *args: P.args, **kwargs: P.kwargs) -> list[Part]:
        return shop.as_objects(make(shop, *args, **kwargs))

    return made


def _legs(width: float, depth: float, height: float, thickness: float) -> list[TexturedPatch]:
    """Create four square legs under a rectangle whose back is at y = 0."""
    x = width / 2 - thickness
    corners = [(sx, y) for sx in (-x, x) for y in (-thickness, thickness - depth)]
    return [p for sx, y in corners for p in box((thickness, thickness, height), (sx, y, 0.0))]


@piece
def bed(shop: Workshop) -> list[Part]:
    """A double bed, 1.6 x 2.05 m, with comforter, blanket and two pillows."""
    frame = shop.pick(WOODS)
    cover = shop.pick(CLOTHS)
    wood = box((1.66, 0.06, 0.95), (0.0, -0.03, 0.0)) + box((1.64, 2.0, 0.3), (0.0, -1.06, 0.0))
    parts = [
        shop.part("bed", wood, tx.wood(frame)),
        shop.part("bed", cushion((1.62, 1.98, 0.26), (0.0, -1.06, 0.28), 8.0), tx.weave(PALE)),
        shop.part(
            "comforter",
            cushion((1.7, 1.4, 0.2), (0.0, -1.38, 0.4), 8.0),
            tx.plaid(cover, (PALE, shop.pick(CLOTHS)), 0.28),
        ),
        shop.part(
            "blanket",
            cushion((1.72, 0.5, 0.09), (0.0, -1.72, 0.545), 8.0),
            tx.stripes(shop.pick(CLOTHS), PALE, 0.1),
        ),
    ]
    for x in (-0.4, 0.4):
        pillow = cushion((0.65, 0.42, 0.16), (x, -0.33, 0.51), 3.0)
        parts.append(shop.part("pillow", pillow, tx.weave((0.85, 0.82, 0.76), 0.02, 0.1)))
    return parts


@piece
def sofa(shop: Workshop) -> list[Part]:
    """A sofa, 1.9 x 0.88 m, with two cushions on it."""
    cloth = shop.pick(CLOTHS)
    body = (
        box((1.9, 0.2, 0.78), (0.0, -0.1, 0.0))
        + box((0.18, 0.68, 0.6), (-0.86, -0.54, 0.0))
        + box((0.18, 0.68, 0.6), (0.86, -0.54, 0.0))
        + box((1.54, 0.66, 0.28), (0.0, -0.53, 0.0))
    )
    for x in (-0.385, 0.385):
        body += cushion((0.77, 0.66, 0.18), (x, -0.53, 0.26), 8.0)
    parts = [shop.part("sofa", body, tx.weave(cloth, 0.018, 0.11))]
    for x, lean in ((-0.5, 0.25), (0.48, -0.2)):
        patches = [_leaning(p, x, lean) for p in cushion((0.44, 0.44, 0.14), (0.0, 0.0, 0.0))]
        bands = (shop.pick(CLOTHS), PALE)
        parts.append(shop.part("cushion", patches, tx.plaid(shop.pick(CLOTHS), bands, 0.11)))
    return parts


def _leaning(patch: TexturedPatch, x: float, yaw_rad: float) -> TexturedPatch:
    """Rotate a horizontal cushion so that it leans against the back of the sofa."""
    upright = se3.exp_so3(np.array([0.0, 0.0, yaw_rad])) @ se3.exp_so3(np.array([1.15, 0.0, 0.0]))
    place = np.array([x, -0.36, 0.66])
    return patch.transformed(se3.from_rotation_translation(upright, place))


@piece
def wardrobe(shop: Workshop) -> list[Part]:
    """A wardrobe, 1.2 x 0.55 x 2.05 m, with two doors and handles."""
    colour = shop.pick(WOODS)
    doors = [p for x in (-0.3, 0.3) for p in box((0.57, 0.02, 1.9), (x, -0.56, 0.08))]
    handles = [p for x in (-0.06, 0.06) for p in box((0.02, 0.03, 0.22), (x, -0.585, 0.95))]
    return [
        shop.part("wardrobe", box((1.2, 0.55, 2.05), (0.0, -0.275, 0.0)), tx.wood(colour)),
        shop.part("wardrobe", doors, tx.wood(shop.pick(WOODS), 0.11), finish=Finish.MIRROR),
        shop.part("wardrobe", handles, tx.speckled(DARK)),
    ]


@piece
def desk(shop: Workshop) -> list[Part]:
    """A desk, 1.3 x 0.65 m, 0.74 m high, without objects on it."""
    top = box((1.3, 0.65, 0.04), (0.0, -0.325, 0.7))
    body = _legs(1.3, 0.65, 0.7, 0.05) + box((0.36, 0.5, 0.4), (0.42, -0.3, 0.3))
    return [
        shop.part("desk", top, tx.wood(shop.pick(WOODS), 0.11)),
        shop.part("desk", body, tx.wood(shop.pick(WOODS))),
    ]


@piece
def table(
    shop: Workshop, width: float = 1.2, depth: float = 0.8, height: float = 0.74
) -> list[Part]:
    """A table with its back edge at y = 0."""
    top = box((width, depth, 0.035), (0.0, -depth / 2, height - 0.035))
    legs = _legs(width, depth, height - 0.035, 0.06)
    colour = shop.pick(WOODS)
    return [shop.part("table", top + legs, tx.wood(colour, 0.11))]


@piece
def round_table(shop: Workshop, radius: float = 0.45, height: float = 0.45) -> list[Part]:
    """A round table with its edge at y = 0."""
    x, y = 0.0, -radius
    patches = cylinder(radius, 0.03, (x, y, height - 0.03))
    patches += cylinder(0.035, height - 0.05, (x, y, 0.02)) + cylinder(0.22, 0.02, (x, y, 0.0))
    return [shop.part("table", patches, tx.wood(shop.pick(WOODS), 0.11))]


@piece
def chair(shop: Workshop) -> list[Part]:
    """A wooden chair, 0.45 m wide, 0.9 m high, with its back at y = 0."""
    wood = _legs(0.45, 0.45, 0.43, 0.04)
    for x in (-0.205, 0.205):
        wood += box((0.035, 0.035, 0.47), (x, -0.02, 0.45))
    for z in (0.6, 0.72, 0.84):
        wood += box((0.375, 0.02, 0.07), (0.0, -0.02, z))
    wood += box((0.46, 0.46, 0.03), (0.0, -0.23, 0.42))
    seat = cushion((0.43, 0.42, 0.05), (0.0, -0.24, 0.445), 6.0)
    return [
        shop.part("chair", wood, tx.wood(shop.pick(WOODS))),
        shop.part("chair", seat, tx.weave(shop.pick(CLOTHS), 0.02, 0.11)),
    ]


@piece
def stool(shop: Workshop) -> list[Part]:
    """A round stool, 0.34 m wide."""
    patches = cylinder(0.17, 0.05, (0.0, -0.17, 0.42)) + cylinder(0.03, 0.42, (0.0, -0.17, 0.0))
    patches += cylinder(0.15, 0.025, (0.0, -0.17, 0.0))
    return [shop.part("stool", patches, tx.wood(shop.pick(WOODS), 0.11))]


@piece
def shelf(shop: Workshop, width: float = 0.9, height: float = 1.85) -> list[Part]:
    """An open shelf, 0.3 m deep, with rows of books and a few objects."""
    depth, board = 0.3, 0.025
    body = box((width, 0.015, height), (0.0, -0.0075, 0.0))
    for x in (-(width - board) / 2, (width - board) / 2):
        body += box((board, depth - 0.02, height), (x, -depth / 2 - 0.005, 0.0))
    levels = np.linspace(0.06, height - board, 6)
    for z in levels:
        body += box((width - 2 * board, depth - 0.02, board), (0.0, -depth / 2 - 0.005, float(z)))
    parts = [shop.part("shelf", body, tx.wood(shop.pick(WOODS)))]
    for z in levels[:-1]:
        parts += _book_row(shop, width - 2 * board - 0.04, float(z) + board)
    return parts


def _book_row(shop: Workshop, length: float, z: float) -> list[Part]:
    """Create a row of books from the left that ends at a random position."""
    parts: list[Part] = []
    x = -length / 2
    end = x + length * shop.rng.uniform(0.55, 1.0)
    while True:
        thickness, height = shop.rng.uniform(0.025, 0.055), shop.rng.uniform(0.17, 0.25)
        if x + thickness > end:
            return parts
        depth = shop.rng.uniform(0.16, 0.22)
        patches = box((thickness - 0.002, depth, height), (x + thickness / 2, -0.03 - depth / 2, z))
        parts.append(shop.part("book", patches, pictures.spine()))
        x += thickness


@piece
def cabinet(shop: Workshop, width: float = 1.1, name: str = "cabinet") -> list[Part]:
    """A low cabinet, 0.42 m deep, 0.75 m high, with drawers."""
    body = box((width, 0.42, 0.75), (0.0, -0.21, 0.0))
    drawers, knobs = [], []
    for x in (-width / 4, width / 4):
        for z in (0.06, 0.29, 0.52):
            drawers += box((width / 2 - 0.03, 0.018, 0.2), (x, -0.429, z))
            knobs += box((0.12, 0.02, 0.02), (x, -0.448, z + 0.1))
    return [
        shop.part(name, body, tx.wood(shop.pick(WOODS))),
        shop.part(name, drawers, tx.wood(shop.pick(WOODS), 0.12)),
        shop.part(name, knobs, tx.speckled(DARK)),
    ]


@piece
def nightstand(shop: Workshop) -> list[Part]:
    """A nightstand, 0.45 x 0.4 x 0.5 m."""
    body = box((0.45, 0.4, 0.5), (0.0, -0.2, 0.0))
    fronts = [p for z in (0.05, 0.27) for p in box((0.41, 0.016, 0.2), (0.0, -0.408, z))]
    return [
        shop.part("nightstand", body, tx.wood(shop.pick(WOODS))),
        shop.part("nightstand", fronts, tx.wood(shop.pick(WOODS), 0.12)),
    ]


@piece
def floor_lamp(shop: Workshop) -> list[Part]:
    """A standing lamp, 1.6 m high, 0.4 m wide."""
    y = -0.22
    stand = cylinder(0.14, 0.025, (0.0, y, 0.0)) + cylinder(0.015, 1.3, (0.0, y, 0.025))
    return [
        shop.part("lamp", stand, tx.speckled(DARK)),
        shop.part("lamp", _shade(0.13, 0.2, 0.3, (0.0, y, 1.28)), _shade_cloth(shop), glow=0.95),
    ]


@piece
def table_lamp(shop: Workshop) -> list[Part]:
    """A lamp for a nightstand or a desk, 0.42 m high, 0.24 m wide."""
    y = -0.14
    profile = [(0.02, 0.24), (0.05, 0.18), (0.07, 0.1), (0.04, 0.03), (0.07, 0.0)]
    foot = [lathe(profile, (0.0, y, 0.0))]
    return [
        shop.part("lamp", foot, tx.banded(shop.pick(CLOTHS), PALE, 0.05)),
        shop.part("lamp", _shade(0.07, 0.12, 0.19, (0.0, y, 0.23)), _shade_cloth(shop), glow=0.95),
    ]


def _shade(
    top: float, bottom: float, height: float, base: tuple[float, float, float]
) -> list[TexturedPatch]:
    x, y, z = base
    rings = np.linspace(0.0, 1.0, 4)
    profile = [(top + (bottom - top) * s, height * (1 - s)) for s in rings]
    return [lathe(profile, base), disk(top, (x, y, z + height)), disk(bottom, base, up=False)]


def _shade_cloth(shop: Workshop) -> Texture:
    return tx.banded((0.93, 0.87, 0.72), shop.pick(CLOTHS), 0.09)


@piece
def curtain(shop: Workshop, width: float, height: float) -> list[Part]:
    """A curtain with folds, its back at y = 0 and its lower edge at z = 0."""
    flat = fine_plate((-width / 2, -0.06, height), (width, 0, 0), (0, 0, -height), (40, 8))
    phase = shop.rng.uniform(0, 2 * np.pi)

    def folds(u: NDArray, _: NDArray) -> NDArray:
        return 0.03 * np.sin(u / 0.11 * 2 * np.pi / 1.2 + phase)

    texture = tx.plaid(shop.pick(CLOTHS), (shop.pick(CLOTHS), PALE), 0.17)
    return [shop.part("curtain", [bent(flat, folds)], texture)]
