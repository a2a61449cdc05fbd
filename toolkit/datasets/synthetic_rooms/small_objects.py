"""Small objects on furniture or on walls, and plants.

Standing objects have their base at z = 0 and are centred at x = y = 0. Hanging objects have their
back at y = 0 and their front towards -y, and are centred at x = z = 0.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import pictures
from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.finishes import Finish
from toolkit.datasets.synthetic_rooms.furniture import CLOTHS, DARK, PALE, WOODS, Workshop, piece
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.patches import (
    TexturedPatch,
    bent,
    box,
    cylinder,
    disk,
    ellipsoid,
    fine_plate,
    lathe,
)


@piece
def vase(shop: Workshop) -> list[Part]:
    """A vase, 0.28 m high."""
    profile = [(0.035, 0.28), (0.03, 0.24), (0.07, 0.16), (0.075, 0.1), (0.04, 0.0)]
    texture = tx.banded(shop.pick(CLOTHS), PALE, 0.055)
    return [shop.part("vase", [lathe(profile), disk(0.035, (0, 0, 0.275))], texture)]


@piece
def bowl(shop: Workshop) -> list[Part]:
    """A bowl, 0.24 m wide."""
    profile = [(0.12, 0.08), (0.11, 0.05), (0.07, 0.015), (0.05, 0.0)]
    inside = [(0.02, 0.015), (0.07, 0.025), (0.105, 0.055), (0.12, 0.08)]
    return [shop.part("bowl", [lathe(profile), lathe(inside)], tx.banded(PALE, shop.pick(CLOTHS)))]


@piece
def bottle(shop: Workshop) -> list[Part]:
    """A bottle, 0.28 m high."""
    profile = [(0.014, 0.28), (0.014, 0.21), (0.036, 0.16), (0.036, 0.0)]
    return [
        shop.part(
            "bottle",
            [lathe(profile), disk(0.014, (0, 0, 0.28))],
            tx.banded((0.2, 0.4, 0.28), PALE, 0.12),
        )
    ]


@piece
def cup(shop: Workshop) -> list[Part]:
    """A mug."""
    return [shop.part("cup", cylinder(0.042, 0.1), tx.banded(shop.pick(CLOTHS), PALE, 0.04))]


@piece
def books(shop: Workshop) -> list[Part]:
    """A stack of three books."""
    parts, z = [], 0.0
    for _ in range(3):
        height = shop.rng.uniform(0.025, 0.045)
        size = (shop.rng.uniform(0.17, 0.2), shop.rng.uniform(0.22, 0.26), height)
        patches = box(size, (shop.rng.uniform(-0.01, 0.01), 0.0, z))
        parts.append(shop.part("book", patches, pictures.spine()))
        z += height
    return parts


@piece
def carton(shop: Workshop, size: tuple[float, float, float] = (0.4, 0.32, 0.3)) -> list[Part]:
    """A cardboard box with a printed pattern."""
    texture = tx.plaid((0.68, 0.52, 0.34), ((0.6, 0.44, 0.28), (0.35, 0.25, 0.17)), 0.19)
    return [shop.part("box", box(size), texture)]


@piece
def bin_(shop: Workshop) -> list[Part]:
    """A waste-paper bin, 0.32 m high."""
    profile = [(0.14, 0.32), (0.13, 0.16), (0.11, 0.0)]
    patches = [lathe(profile), lathe([(0.10, 0.02), (0.135, 0.32)]), disk(0.1, (0, 0, 0.02))]
    return [shop.part("bin", patches, tx.banded(shop.pick(CLOTHS), DARK, 0.05))]


@piece
def basket(shop: Workshop) -> list[Part]:
    """A wicker basket, 0.3 m high."""
    profile = [(0.2, 0.3), (0.22, 0.15), (0.18, 0.0)]
    patches = [lathe(profile), disk(0.2, (0, 0, 0.28))]
    return [shop.part("basket", patches, tx.weave((0.66, 0.5, 0.3), 0.03, 0.22))]


@piece
def ball(shop: Workshop) -> list[Part]:
    """An exercise ball."""
    patches = [ellipsoid((0.27, 0.27, 0.265), (0, 0, 0.265))]
    return [shop.part("exercise-ball", patches, tx.banded(shop.pick(CLOTHS), PALE, 0.1))]


@piece
def sculpture(shop: Workshop) -> list[Part]:
    """A lathe-turned sculpture, 0.35 m high."""
    profile = [(0.0, 0.35), (0.05, 0.31), (0.025, 0.25), (0.07, 0.15), (0.03, 0.06), (0.06, 0.0)]
    return [shop.part("sculpture", [lathe(profile)], tx.speckled((0.55, 0.5, 0.46), 0.15))]


@piece
def monitor(shop: Workshop) -> list[Part]:
    """A 0.56 m wide monitor on a stand with its screen towards -y."""
    case = box((0.56, 0.035, 0.35), (0.0, 0.0, 0.1)) + box((0.05, 0.03, 0.12), (0.0, 0.03, 0.0))
    case += box((0.24, 0.18, 0.012))
    face = fine_plate((-0.27, -0.0185, 0.44), (0.54, 0, 0), (0, 0, -0.33), (4, 3))
    return [
        shop.part("monitor", case, tx.speckled(DARK, 0.12)),
        shop.part("monitor", [face], pictures.screen(), 0.95, Finish.SCREEN),
    ]


@piece
def keyboard(shop: Workshop) -> list[Part]:
    """A keyboard."""
    return [shop.part("computer-keyboard", box((0.42, 0.14, 0.02)), pictures.keys())]


@piece
def computer(shop: Workshop) -> list[Part]:
    """A desktop computer's case, 0.42 m high."""
    return [
        shop.part(
            "desktop-computer", box((0.19, 0.42, 0.42)), tx.stripes(DARK, (0.4, 0.4, 0.42), 0.05)
        )
    ]


@piece
def plant(shop: Workshop, height: float = 1.3) -> list[Part]:
    """A pot with a plant of arching leaves, about 0.9 m wide."""
    pot_height = 0.3
    pot = [
        lathe([(0.17, pot_height), (0.16, 0.2), (0.12, 0.0)]),
        disk(0.165, (0, 0, pot_height - 0.02)),
    ]
    stem = cylinder(0.018, (height - pot_height) * 0.6, (0, 0, pot_height - 0.02))
    leaves = [
        _leaf(shop.rng, number, pot_height + (height - pot_height) * 0.55 * number / 13)
        for number in range(14)
    ]
    return [
        shop.part("pot", pot, tx.banded(shop.pick(CLOTHS), (0.75, 0.7, 0.6), 0.08)),
        shop.part("indoor-plant", stem, tx.wood((0.4, 0.3, 0.18))),
        shop.part("indoor-plant", leaves, pictures.leaf()),
    ]


def _leaf(rng: np.random.Generator, number: int, z: float) -> TexturedPatch:
    """Create an arching leaf, pointed at both ends, that starts at the stem at height z."""
    length, width = rng.uniform(0.36, 0.5), rng.uniform(0.1, 0.14)
    along = np.linspace(0.0, 1.0, 9)
    arch = np.stack([along * length * 0.85, 0.34 * along * (1.25 - along)], axis=-1)
    half = width / 2 * np.sin(np.pi * np.clip(along * 0.96 + 0.03, 0, 1)) ** 0.7
    across = np.linspace(-1.0, 1.0, 5)
    points = np.stack(
        [
            np.repeat(arch[:, :1], 5, axis=1),
            half[:, None] * across,
            arch[:, 1:] - 0.02 * (1 - np.abs(across)),
        ],
        axis=-1,
    )
    uv_m = np.stack(
        [(half[:, None] * across) + width / 2, np.repeat(along[:, None] * length, 5, 1)], -1
    )
    turn = number * math.radians(137.5) + rng.uniform(-0.2, 0.2)
    T = se3.from_rotation_translation(se3.exp_so3(np.array([0, 0, turn])), np.array([0, 0, z]))
    return TexturedPatch(points, uv_m, np.ones((8, 4), dtype=bool)).transformed(T)


@piece
def picture(
    shop: Workshop, width: float = 0.7, height: float = 0.5, finish: Finish = Finish.MATT
) -> list[Part]:
    """A framed abstract painting."""
    palette = np.clip(shop.rng.random((5, 3)) * 0.8 + 0.1, 0, 1)
    patches = box((width, 0.025, height), (0.0, -0.0125, -height / 2))
    return [shop.part("picture", patches, pictures.painting(palette), finish=finish)]


@piece
def clock(shop: Workshop) -> list[Part]:
    """A round wall clock, 0.32 m wide."""
    T = se3.from_rotation_translation(se3.exp_so3(np.array([math.pi / 2, 0, 0])), np.zeros(3))
    patches = [p.transformed(T) for p in cylinder(0.16, 0.035)]
    return [shop.part("clock", patches, pictures.dial())]


@piece
def television(shop: Workshop) -> list[Part]:
    """A 1.1 m wide flat screen on the wall."""
    case = box((1.1, 0.05, 0.64), (0.0, -0.025, -0.32))
    face = fine_plate((-0.535, -0.0515, 0.305), (1.07, 0, 0), (0, 0, -0.61), (6, 4))
    return [
        shop.part("tv-screen", case, tx.speckled(DARK, 0.12)),
        shop.part("tv-screen", [face], pictures.landscape(bar_m=0.0), 0.95, Finish.SCREEN),
    ]


@piece
def blinds(shop: Workshop, width: float, height: float) -> list[Part]:
    """Horizontal blinds of slats, hanging from z = 0 down to -height."""
    flat = fine_plate(
        (-width / 2, -0.05, 0.0), (width, 0, 0), (0, 0, -height), (6, int(height / 0.02))
    )

    def slats(_: NDArray, v: NDArray) -> NDArray:
        return 0.012 * (v / 0.08 % 1.0)

    return [shop.part("blinds", [bent(flat, slats)], tx.banded(PALE, shop.pick(WOODS), 0.08))]


@piece
def switch(shop: Workshop) -> list[Part]:
    """A light switch."""
    patches = box((0.09, 0.012, 0.09), (0, -0.006, -0.045)) + box(
        (0.04, 0.02, 0.05), (0, -0.01, -0.025)
    )
    return [shop.part("switch", patches, tx.speckled((0.9, 0.89, 0.85)))]


@piece
def rug(shop: Workshop, width: float = 2.0, depth: float = 1.4) -> list[Part]:
    """A patterned rug."""
    texture = tx.carpet(shop.pick(CLOTHS), shop.pick((PALE, DARK, (0.75, 0.6, 0.4))))
    return [shop.part("rug", box((width, depth, 0.012)), texture)]
