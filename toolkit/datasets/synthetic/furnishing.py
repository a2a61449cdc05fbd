"""Puts furniture into a room: groups of pieces find free places along the walls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic import furniture as big
from toolkit.datasets.synthetic import small_objects as small
from toolkit.datasets.synthetic.furniture import Workshop
from toolkit.datasets.synthetic.parts import Part, bounds, moved
from toolkit.datasets.synthetic.patches import placement
from toolkit.datasets.synthetic.shell import SIDES, RoomPlan, Side

Group = Callable[[Workshop], list[Part]]

_GAP_M = 0.04
_STEP_M = 0.1


def _bed_group(shop: Workshop) -> list[Part]:
    parts = big.bed(shop)
    parts += moved(big.nightstand(shop), placement(1.1, 0.0))
    parts += moved(big.table_lamp(shop), placement(1.1, -0.05, 0.5))
    parts += moved(small.cup(shop), placement(1.0, -0.33, 0.5))
    return parts


def _desk_group(shop: Workshop) -> list[Part]:
    parts = big.desk(shop)
    parts += moved(small.monitor(shop), placement(-0.05, -0.2, 0.74))
    parts += moved(small.keyboard(shop), placement(-0.05, -0.45, 0.74))
    parts += moved(big.table_lamp(shop), placement(-0.5, -0.05, 0.74))
    parts += moved(small.cup(shop), placement(0.35, -0.5, 0.74))
    parts += moved(small.books(shop), placement(0.45, -0.25, 0.74))
    parts += moved(small.computer(shop), placement(-0.45, -0.33, 0.0))
    parts += moved(big.chair(shop), placement(0.0, -1.15, 0.0, np.pi + 0.2))
    return parts


def _sofa_group(shop: Workshop) -> list[Part]:
    parts = big.sofa(shop)
    parts += moved(small.rug(shop), placement(0.0, -1.6))
    parts += moved(big.round_table(shop), placement(0.0, -1.15))
    parts += moved(small.vase(shop), placement(0.15, -1.5, 0.45))
    parts += moved(small.bowl(shop), placement(-0.15, -1.75, 0.45))
    parts += moved(small.books(shop), placement(-0.2, -1.42, 0.45))
    return parts


def _television_group(shop: Workshop) -> list[Part]:
    parts = big.cabinet(shop, 1.2, "tv-stand")
    parts += moved(small.television(shop), placement(0.0, 0.03, 1.3))
    parts += moved(small.bottle(shop), placement(-0.45, -0.2, 0.75))
    parts += moved(small.sculpture(shop), placement(0.48, -0.2, 0.75))
    return parts


def _dining_group(shop: Workshop) -> list[Part]:
    parts = moved(big.table(shop), placement(0.0, -0.35))
    parts += moved(small.vase(shop), placement(0.1, -0.75, 0.74))
    parts += moved(small.bowl(shop), placement(-0.3, -0.6, 0.74))
    for x in (-0.35, 0.35):
        parts += moved(big.chair(shop), placement(x, -1.5, 0.0, np.pi))
    return parts


def _cabinet_group(shop: Workshop) -> list[Part]:
    parts = big.cabinet(shop)
    parts += moved(small.basket(shop), placement(0.28, -0.22, 0.75))
    parts += moved(small.books(shop), placement(-0.3, -0.2, 0.75))
    return parts


def _boxes_group(shop: Workshop) -> list[Part]:
    parts = moved(small.carton(shop), placement(0.0, -0.2))
    parts += moved(small.carton(shop, (0.28, 0.24, 0.2)), placement(0.03, -0.2, 0.3, 0.4))
    return parts


def _standing(piece: Group, reach_m: float) -> Group:
    """A centred piece as a group with its back on y = 0."""
    return lambda shop: moved(piece(shop), placement(0.0, -reach_m))


_PLANT = _standing(small.plant, 0.48)
_BIN = _standing(small.bin_, 0.18)
_BALL = _standing(small.ball, 0.3)

# Large groups first: they need the long free stretches of wall.
STYLES: dict[str, tuple[Group, ...]] = {
    "studio": (
        _bed_group, _sofa_group, _desk_group, _television_group, big.wardrobe, big.shelf,
        _PLANT, big.floor_lamp, _boxes_group, _BIN, big.stool, _BALL,
    ),
    "bedroom": (_bed_group, big.wardrobe, _cabinet_group, big.floor_lamp, _PLANT, _BIN),
    "living": (_sofa_group, _television_group, big.shelf, _PLANT, big.floor_lamp, big.stool),
    "office": (_desk_group, big.shelf, _cabinet_group, _boxes_group, _PLANT, _BIN),
    "dining": (_dining_group, _cabinet_group, big.shelf, big.stool, _BALL, _PLANT),
    "corridor": (_boxes_group, big.stool),
}  # fmt: skip


@dataclass
class _Floor:
    """What is taken already: boxes [2, 3] in the world."""

    taken: list[NDArray[np.float64]] = field(default_factory=list)

    def is_free(self, box_m: NDArray[np.float64]) -> bool:
        return not any(
            bool((box_m[0] < other[1]).all() and (box_m[1] > other[0]).all())
            for other in self.taken
        )


def furnish(plan: RoomPlan, shop: Workshop) -> list[Part]:
    """Furniture, then pictures on what is left of the walls."""
    floor = _Floor(_kept_clear(plan))
    parts: list[Part] = []
    for group in STYLES[plan.style]:
        piece = group(shop)
        T = _free_place(plan, bounds(piece), floor, shop.rng)
        if T is not None:
            placed = moved(piece, T)
            floor.taken.append(bounds(placed))
            parts += placed
    return parts + _wall_hangings(plan, shop, floor)


def _kept_clear(plan: RoomPlan) -> list[NDArray[np.float64]]:
    """Boxes before doors and windows, and the way of the camera in the middle."""
    clear = []
    for opening in plan.openings:
        left, low, right, high = opening.extent_m
        deep = 0.12 if opening.kind == "window" else 0.9
        margin = 0.3 if opening.kind == "window" else 0.1
        corners = np.array([[left - margin, -deep, low], [right + margin, 0.0, high]])
        origin = plan.on_wall(opening.side, 0.0)
        clear.append(_world_box(origin, corners))
    x, y = plan.centre_m
    reach = path_reach_m(plan) + 0.5
    clear.append(
        np.array([[x - reach[0], y - reach[1], 0.95], [x + reach[0], y + reach[1], 2.2]])
    )
    return clear


def path_reach_m(plan: RoomPlan) -> NDArray[np.float64]:
    """Half axes [2] of the loop that the camera walks in a room, metres."""
    size = np.array([plan.x1 - plan.x0, plan.y1 - plan.y0])
    return np.clip(size / 2 - 1.6, 0.25, 1.0)


def _world_box(T: NDArray, corners: NDArray) -> NDArray[np.float64]:
    world = corners @ T[:3, :3].T + T[:3, 3]
    return np.stack([world.min(axis=0), world.max(axis=0)])


def _free_place(
    plan: RoomPlan, size: NDArray, floor: _Floor, rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """A motion [4, 4] to a free place along a wall, or None where there is none."""
    places: list[tuple[Side, float]] = []
    for side in SIDES:
        first = 0.05 - size[0, 0]
        last = plan.wall_length_m(side) - 0.05 - size[1, 0]
        places += [(side, along) for along in np.arange(first, last, _STEP_M)]
    for number in rng.permutation(len(places)):
        side, along = places[number]
        T = plan.on_wall(side, along, gap_m=_GAP_M)
        box_m = _world_box(T, size)
        inside = box_m[0] > [plan.x0, plan.y0, -0.01]
        inside &= box_m[1] < [plan.x1, plan.y1, plan.height_m]
        if inside.all() and floor.is_free(box_m):
            return T
    return None


def _wall_hangings(plan: RoomPlan, shop: Workshop, floor: _Floor) -> list[Part]:
    """Pictures and a clock at eye height, a switch beside each door."""
    parts: list[Part] = []
    for opening in plan.openings:
        if opening.kind != "window":
            T = plan.on_wall(opening.side, opening.extent_m[2] + 0.15, 1.1)
            parts += moved(small.switch(shop), T)
    hangings: list[Group] = [
        small.clock,
        small.picture,
        lambda s: small.picture(s, 0.5, 0.65),
        lambda s: small.picture(s, 0.9, 0.6),
        lambda s: small.picture(s, 0.4, 0.4),
    ]
    for group in hangings:
        piece = moved(group(shop), placement(0.0, _GAP_M, 1.65))
        T = _free_place(plan, bounds(piece) - [[0.1, 0, 0], [-0.1, 0, 0]], floor, shop.rng)
        if T is not None:
            placed = moved(piece, T)
            floor.taken.append(bounds(placed))
            parts += placed
    return parts
