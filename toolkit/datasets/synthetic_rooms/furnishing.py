"""Placement of furniture in a room: groups of pieces are placed along the walls."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms import furniture as big
from toolkit.datasets.synthetic_rooms import small_objects as small
from toolkit.datasets.synthetic_rooms.finishes import Finish
from toolkit.datasets.synthetic_rooms.furniture import Workshop
from toolkit.datasets.synthetic_rooms.parts import Part, bounds, moved
from toolkit.datasets.synthetic_rooms.patches import placement
from toolkit.datasets.synthetic_rooms.shell import SIDES, Opening, RoomPlan, Side

Group = Callable[[Workshop], list[Part]]

Box = NDArray[np.float64]  # lowest and highest corner [2, 3], metres

_GAP_M = 0.04
_STEP_M = 0.1
_FLAT_M = 0.02
_ATTEMPTS = 40
# Every n-th piece, the largest ones, stays where it is in a rearranged room.
_KEPT = 3


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


def _table_of_objects(shop: Workshop) -> list[Part]:
    """Objects on a round table whose centre is the origin."""
    parts = moved(big.round_table(shop), placement(0.0, 0.45))
    parts += moved(small.vase(shop), placement(0.0, 0.05, 0.45))
    parts += moved(small.books(shop), placement(0.2, -0.1, 0.45, 0.06))
    parts += moved(small.bowl(shop), placement(-0.22, 0.05, 0.45))
    parts += moved(small.sculpture(shop), placement(0.05, 0.25, 0.45))
    parts += moved(small.cup(shop), placement(-0.08, -0.22, 0.45))
    parts += moved(small.plant(shop, 0.35), placement(0.0, -0.3, 0.45))
    return parts


def _standing(piece: Group, reach_m: float) -> Group:
    """Return a group of one piece, shifted so that its back is at y = 0."""
    return lambda shop: moved(piece(shop), placement(0.0, -reach_m))


_PLANT = _standing(small.plant, 0.48)
_BIN = _standing(small.bin_, 0.18)
_BALL = _standing(small.ball, 0.3)

# Large groups first, because they need long free sections of a wall.
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
    "bare": (),
    "display": (_sofa_group, _cabinet_group, big.wardrobe, big.shelf, big.floor_lamp, _BIN),
}  # fmt: skip

# What stands in the middle of a room, where no other style has anything.
_MIDDLE: dict[str, Group] = {"display": _table_of_objects}


def furnish(plan: RoomPlan, shop: Workshop, rearranged: bool = False) -> list[Part]:
    """Place furniture along the walls and pictures in the remaining space; nothing in bare rooms.

    Several random arrangements are tried. The first one that places all pieces is used, otherwise
    the one that places most.

    Args:
        rearranged: place all but the largest pieces elsewhere, or leave them out where there is no
            place; walls and what hangs on them stay the same.
    """
    if not STYLES[plan.style]:
        return []
    pieces = dict(enumerate(group(shop) for group in STYLES[plan.style]))
    best: dict[int, list[Part]] = {}
    for rng in shop.rng.spawn(_ATTEMPTS):
        placed = _arrange(plan, pieces, rng, _kept_clear(plan))
        if len(placed) > len(best):
            best = placed
        if len(best) == len(pieces):
            break
    middle = []
    if plan.style in _MIDDLE:
        middle = moved(_MIDDLE[plan.style](shop), placement(*plan.centre_m))
    parts = _all_parts(best) + middle
    hangings = _wall_hangings(plan, shop, _blocks(parts) + _kept_clear(plan))
    if rearranged:
        kept = dict(list(best.items())[: len(best) // _KEPT])
        others = {number: pieces[number] for number in best if number not in kept}
        taken = _kept_clear(plan) + _blocks(_all_parts(kept) + middle)
        parts = _all_parts(kept | _arrange(plan, others, shop.rng.spawn(1)[0], taken)) + middle
    return parts + hangings


def _all_parts(pieces: Mapping[int, list[Part]]) -> list[Part]:
    return [part for piece in pieces.values() for part in piece]


def _arrange(
    plan: RoomPlan,
    pieces: Mapping[int, list[Part]],
    rng: np.random.Generator,
    taken: list[Box],
) -> dict[int, list[Part]]:
    """Place the pieces in the world outside `taken`; those without a free place are omitted."""
    placed = {}
    for number, piece in pieces.items():
        T = _free_place(plan, bounds(piece), _blocks(piece), taken, rng)
        if T is not None:
            placed[number] = moved(piece, T)
            taken = taken + _blocks(placed[number])
    return placed


def _blocks(parts: list[Part]) -> list[Box]:
    """Return the bounding boxes of the parts, except flat ones such as rugs."""
    boxes = [bounds([part]) for part in parts]
    return [b for b in boxes if b[1, 2] - b[0, 2] > _FLAT_M]


def _kept_clear(plan: RoomPlan) -> list[Box]:
    """Return the boxes in front of doors and windows and around the camera path."""
    clear = []
    for opening in plan.openings:
        left, low, right, high = opening.extent_m
        if opening.kind == "window":
            corners = np.array([[left - 0.35, -0.15, low - 0.25], [right + 0.35, 0.0, high + 0.2]])
        else:
            corners = np.array([[left - 0.1, -0.9, low], [right + 0.1, 0.0, high]])
        if opening.kind == "passage":
            lane = np.array([[left, -_half_way(plan, opening), 0.95], [right, 0.0, high]])
            clear.append(_moved_box(plan.on_wall(opening.side, 0.0), lane))
        clear.append(_moved_box(plan.on_wall(opening.side, 0.0), corners))
    x, y = plan.centre_m
    reach = path_reach_m(plan) + 0.5
    clear.append(np.array([[x - reach[0], y - reach[1], 0.95], [x + reach[0], y + reach[1], 2.2]]))
    return clear


def _half_way(plan: RoomPlan, opening: Opening) -> float:
    """Return the distance from a wall to the centre of the room, metres."""
    return plan.size_m[1 if opening.side in ("north", "south") else 0] / 2


def path_reach_m(plan: RoomPlan) -> NDArray[np.float64]:
    """Return the semi-axes [2] of the camera's loop in a room, metres."""
    return np.clip(np.array(plan.size_m) / 2 - 1.75, 0.2, 0.8)


def _moved_box(T: NDArray, box_m: Box) -> Box:
    """Transform an axis-aligned box by a translation and a rotation by a multiple of 90 degrees."""
    world = box_m @ T[:3, :3].T + T[:3, 3]
    return np.stack([world.min(axis=0), world.max(axis=0)])


def _free_place(
    plan: RoomPlan, extent: Box, blocks: list[Box], taken: list[Box], rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """Find a rigid motion [4, 4] to a free place along a wall; None if there is none.

    Args:
        plan: the room.
        extent: bounding box of the piece, which must be inside the room.
        blocks: bounding boxes of its parts, which must not intersect `taken`.
        taken: occupied boxes in the room.
        rng: source of randomness for the order of the tested places.
    """
    lowest, highest = extent
    others = np.stack(taken)
    places: list[tuple[Side, float]] = []
    for side in SIDES:
        last = plan.wall_length_m(side) - _GAP_M - highest[0]
        places += [(side, along) for along in np.arange(_GAP_M - lowest[0], last, _STEP_M)]
    for number in rng.permutation(len(places)):
        side, along = places[number]
        T = plan.on_wall(side, along, gap_m=_GAP_M)
        if _is_inside(plan, _moved_box(T, extent)) and all(
            _is_apart(_moved_box(T, block), others) for block in blocks
        ):
            return T
    return None


def _is_inside(plan: RoomPlan, box_m: Box) -> bool:
    x0, y0, x1, y1 = plan.bounds_m
    low, high = box_m
    return bool((low > [x0, y0, -0.01]).all() and (high < [x1, y1, plan.height_m]).all())


def _is_apart(box_m: Box, others: NDArray[np.float64]) -> bool:
    low, high = box_m
    apart = (low >= others[:, 1]) | (high <= others[:, 0])
    return bool(apart.any(axis=1).all())


def _wall_hangings(plan: RoomPlan, shop: Workshop, taken: list[Box]) -> list[Part]:
    """Place pictures and a clock at eye height, and a switch beside each door."""
    parts: list[Part] = []
    for opening in plan.openings:
        if opening.kind != "window":
            T = plan.on_wall(opening.side, opening.extent_m[2] + 0.15, 1.1)
            parts += moved(small.switch(shop), T)
    hangings: list[Group] = [
        small.clock,
        lambda s: small.picture(s, 0.9, 0.6, Finish.HUNG_MIRROR),
        lambda s: small.picture(s, 0.7, 0.5),
        lambda s: small.picture(s, 0.5, 0.65),
        lambda s: small.picture(s, 0.4, 0.4),
    ]
    for group in hangings:
        # Undo the gap, so that the piece touches the wall.
        piece = moved(group(shop), placement(0.0, _GAP_M, 1.65))
        # The space in front of it must be free as well.
        around = bounds(piece) + np.array([[-0.12, -0.35, -0.05], [0.12, -_GAP_M, 0.05]])
        place = _free_place(plan, around, [around], taken, shop.rng)
        if place is not None:
            parts += moved(piece, place)
            taken = [*taken, _moved_box(place, around)]
    return parts
