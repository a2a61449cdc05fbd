"""Shell of a room: floor, ceiling, walls with openings, doors and windows."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms import pictures
from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.finishes import Finish
from toolkit.datasets.synthetic_rooms.furniture import PALE, WOODS, Workshop, curtain
from toolkit.datasets.synthetic_rooms.parts import Part, moved
from toolkit.datasets.synthetic_rooms.patches import (
    TexturedPatch,
    box,
    fine_plate,
    placement,
    plate,
)
from toolkit.datasets.synthetic_rooms.small_objects import blinds

Side = Literal["north", "east", "south", "west"]
SIDES: tuple[Side, ...] = ("north", "east", "south", "west")

DOOR_WIDTH_M = 1.1
DOOR_HEIGHT_M = 2.1
# Half the thickness of a wall between two rooms; each room contains its half.
WALL_HALF_M = 0.06


@dataclass(frozen=True)
class Opening:
    """A door or window in a wall.

    Attributes:
        side: wall of the opening.
        centre_m: position along the wall from its left end, seen from inside.
        kind: passage (to another room), door (closed) or window.
    """

    side: Side
    centre_m: float
    kind: Literal["passage", "door", "window"]

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """(left, bottom, right, top) on the wall, metres from its left end and the floor."""
        if self.kind == "window":
            return self.centre_m - 0.7, 0.95, self.centre_m + 0.7, 2.15
        return (
            self.centre_m - DOOR_WIDTH_M / 2,
            0.0,
            self.centre_m + DOOR_WIDTH_M / 2,
            DOOR_HEIGHT_M,
        )


@dataclass(frozen=True)
class RoomPlan:
    """A rectangular room.

    Attributes:
        centre_m: centre (x, y) of the floor.
        size_m: inner size along x and y.
        openings: doors and windows.
        style: style of the furniture, a key of `furnishing.STYLES`.
        height_m: height of the ceiling.
        wall, floor, ceiling: textures in place of the usual ones. With one for the walls, skirting
            boards are plain.
        lamps: number of ceiling lamps along x; by default, one every five metres.
    """

    centre_m: tuple[float, float]
    size_m: tuple[float, float]
    openings: tuple[Opening, ...]
    style: str
    height_m: float = 2.6
    wall: tx.Texture | None = None
    floor: tx.Texture | None = None
    ceiling: tx.Texture | None = None
    lamps: int | None = None

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Positions of the inner walls (x0, y0, x1, y1)."""
        (x, y), (width, depth) = self.centre_m, self.size_m
        return x - width / 2, y - depth / 2, x + width / 2, y + depth / 2

    def wall_length_m(self, side: Side) -> float:
        """Return the length of a wall."""
        return self.size_m[0] if side in ("north", "south") else self.size_m[1]

    def on_wall(self, side: Side, along_m: float, z_m: float = 0.0, gap_m: float = 0.0) -> NDArray:
        """Return the motion [4, 4] that places an object with its back (+y) at a wall.

        Args:
            side: the wall.
            along_m: position from the wall's left end, seen from inside.
            z_m: height.
            gap_m: distance between object and wall.
        """
        x0, y0, x1, y1 = self.bounds_m
        if side == "north":
            return placement(x0 + along_m, y1 - gap_m, z_m, 0.0)
        if side == "east":
            return placement(x1 - gap_m, y1 - along_m, z_m, -math.pi / 2)
        if side == "south":
            return placement(x1 - along_m, y0 + gap_m, z_m, math.pi)
        return placement(x0 + gap_m, y0 + along_m, z_m, math.pi / 2)

    def door_way(self, opening: Opening) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the centre [2] of an opening at floor level and the outward direction [2]."""
        T = self.on_wall(opening.side, opening.centre_m)
        return T[:2, 3], T[:2, 1]


def room_shell(plan: RoomPlan, shop: Workshop) -> list[Part]:
    """Create floor, ceiling, walls, doors and windows of a room; its closed doors are identical."""
    width, depth = plan.size_m
    x0, y0, _, y1 = plan.bounds_m
    floor = plate((x0, y1, 0.0), (width, 0, 0), (0, -depth, 0))
    ceiling = plate((x0, y0, plan.height_m), (width, 0, 0), (0, depth, 0))
    papers = _wall_papers(shop)
    parts = [
        shop.part("floor", [floor], plan.floor or _floor_texture(shop), finish=Finish.LACQUER),
        shop.part("ceiling", [ceiling], plan.ceiling or tx.panels((0.8, 0.8, 0.78))),
    ]
    for side, paper in zip(SIDES, papers, strict=True):
        parts += _wall(plan, side, paper, shop)
    door: list[Part] = []
    for opening in plan.openings:
        if opening.kind == "door":
            door = door or _closed_door(shop)
            fittings = deepcopy(door)  # with equal random streams
        else:
            fittings = _passage(shop) if opening.kind == "passage" else _window(shop)
        parts += moved(fittings, plan.on_wall(opening.side, opening.centre_m))
    return parts


def _floor_texture(shop: Workshop) -> tx.Texture:
    choices = (
        tx.planks(shop.pick(WOODS)),
        tx.tiles((0.78, 0.74, 0.66), (0.45, 0.38, 0.34)),
        tx.planks((0.5, 0.42, 0.34), 0.1, 0.8),
    )
    return choices[int(shop.rng.integers(len(choices)))]


def _wall_papers(shop: Workshop) -> list[tx.Texture]:
    """Return one texture per wall, so that walls differ clearly."""
    tints = ((0.82, 0.76, 0.64), (0.62, 0.72, 0.76), (0.74, 0.8, 0.68), (0.84, 0.7, 0.62))
    first, second = shop.pick(tints), shop.pick(tints)
    papers = [
        tx.stripes(first, tuple(0.9 * c for c in first), 0.16),  # type: ignore[arg-type]
        tx.brick((0.66, 0.4, 0.3)),
        tx.plaster(second, 0.04),
        tx.damask(first, tuple(0.82 * c for c in first)),  # type: ignore[arg-type]
    ]
    return [papers[i] for i in shop.rng.permutation(4)]


def _wall(plan: RoomPlan, side: Side, paper: tx.Texture, shop: Workshop) -> list[Part]:
    """Create the plate of a wall with holes, and its skirting board."""
    length, height = plan.wall_length_m(side), plan.height_m
    extents = [o.extent_m for o in plan.openings if o.side == side]
    holes = tuple((left, height - top, right, height - low) for left, low, right, top in extents)
    T = plan.on_wall(side, 0.0)
    flat = plate((0.0, 0.0, height), (length, 0, 0), (0, 0, -height), holes)
    gaps = sorted((left, right) for left, low, right, _ in extents if low == 0.0)
    starts = [0.0, *(right for _, right in gaps)]
    ends = [*(left for left, _ in gaps), length]
    skirting: list[TexturedPatch] = []
    for start, end in zip(starts, ends, strict=True):
        if end - start > 0.05:
            middle = (start + end) / 2
            skirting += box((end - start, 0.015, 0.08), (middle, -0.0075, 0.0))
    board = tx.wood(PALE, 0.0 if plan.wall else 0.06)
    parts = [shop.part("wall", [flat], plan.wall or paper), shop.part("wall", skirting, board)]
    return moved(parts, T)


def _frame(width: float, low: float, high: float, depth: float) -> list[TexturedPatch]:
    """Create the frame of an opening, centred at x = 0, from y = depth to just before y = 0."""
    thick, front = 0.05, 0.02
    y, deep = (depth - front) / 2, depth + front
    upright = high - low
    sides = [
        p
        for x in (-(width - thick) / 2, (width - thick) / 2)
        for p in box((thick, deep, upright), (x, y, low))
    ]
    return sides + box((width - 2 * thick, deep, thick), (0.0, y, high - thick))


def _passage(shop: Workshop) -> list[Part]:
    frame = _frame(DOOR_WIDTH_M, 0.0, DOOR_HEIGHT_M, WALL_HALF_M)
    return [shop.part("door", frame, tx.wood(shop.pick(WOODS))), _sill(shop, WALL_HALF_M)]


def _sill(shop: Workshop, depth: float) -> Part:
    """Create the floor within an opening."""
    flat = fine_plate((-DOOR_WIDTH_M / 2, depth, 0.0), (DOOR_WIDTH_M, 0, 0), (0, -depth, 0), (8, 1))
    return shop.part("floor", [flat], tx.wood(shop.pick(WOODS)))


def _closed_door(shop: Workshop) -> list[Part]:
    colour = shop.pick(WOODS)
    leaf = box((DOOR_WIDTH_M - 0.1, 0.04, DOOR_HEIGHT_M - 0.05), (0.0, 0.03, 0.0))
    fields = [
        p
        for x in (-0.24, 0.24)
        for z, high in ((0.2, 0.65), (1.05, 0.8))
        for p in box((0.36, 0.02, high), (x, 0.008, z))
    ]
    handle = box((0.14, 0.025, 0.025), (0.36, -0.04, 1.02)) + box(
        (0.03, 0.07, 0.03), (0.42, -0.02, 1.018)
    )
    return [
        shop.part("door", _frame(DOOR_WIDTH_M, 0.0, DOOR_HEIGHT_M, 0.08), tx.wood(PALE, 0.08)),
        shop.part("door", leaf, tx.wood(colour)),
        _sill(shop, 0.08),
        shop.part("door", fields, tx.wood(shop.pick(WOODS), 0.12)),
        shop.part("door", handle, tx.speckled((0.6, 0.6, 0.58))),
    ]


def _window(shop: Workshop) -> list[Part]:
    """Create a recessed pane, a frame and, at random, blinds or curtains."""
    width, low, high, deep = 1.4, 0.95, 2.15, 0.12
    pane = fine_plate((-width / 2, deep, high), (width, 0, 0), (0, 0, low - high), (8, 7))
    reveal = _frame(width, low + 0.05, high, deep)
    reveal += box((width, deep + 0.06, 0.05), (0.0, (deep - 0.06) / 2, low))
    parts = [
        shop.part("window", [pane], pictures.landscape(), glow=1.0),
        shop.part("window", reveal, tx.wood(PALE, 0.08)),
    ]
    if shop.rng.random() < 0.5:
        return parts + moved(blinds(shop, width, 0.45), placement(0.0, 0.0, high + 0.04))
    for x in (-0.78, 0.78):
        parts += moved(curtain(shop, 0.34, 1.55), placement(x, -0.01, 0.75))
    return parts
