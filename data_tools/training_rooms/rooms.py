"""Arrangement of furniture in rooms of several families.

The room lies at 0 <= x <= width, 0 <= y <= depth, the floor at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from data_tools.training_rooms import furniture as f
from data_tools.training_rooms import shell
from data_tools.training_rooms.solids import Piece, box, extent, placed

_ATTEMPTS = 8


@dataclass(frozen=True)
class Family:
    """What a family of rooms contains.

    Attributes:
        size_m: ranges of the length of both sides.
        along_walls: pieces with their backs to a wall, with weights.
        inside: pieces away from the walls, with weights.
        density: pieces per metre of wall. inner_density: pieces per square metre inside.
    """

    size_m: tuple[tuple[float, float], tuple[float, float]]
    along_walls: dict[f.Maker, float]
    inside: dict[f.Maker, float]
    density: float = 0.8
    inner_density: float = 0.09


_ANYTHING: dict[f.Maker, float] = {
    f.cabinet: 2.0, f.shelf: 2.0, f.on_floor: 1.0, f.plant: 1.0, f.floor_lamp: 0.6,
    f.chair: 0.7, f.armchair: 0.7, f.table: 1.0, f.appliance: 0.6,
}  # fmt: skip

FAMILIES: dict[str, Family] = {
    "living": Family(
        ((3.5, 7.5), (3.0, 6.0)),
        _ANYTHING | {f.lounge: 4.0, f.sofa: 1.5, f.desk: 0.6},
        {f.lounge: 2.0, f.with_chairs: 1.5, f.table: 1.5, f.sofa: 0.7, f.armchair: 1.5},
    ),
    "kitchen": Family(
        ((2.4, 5.5), (2.2, 5.0)),
        {
            f.kitchen: 5.0,
            f.fridge: 1.0,
            f.cabinet: 1.0,
            f.shelf: 0.7,
            f.on_floor: 0.5,
            f.table: 0.5,
        },
        {f.with_chairs: 2.0, f.table: 0.5, f.chair: 1.0, f.kitchen: 0.4},
        density=0.9,
    ),
    "office": Family(
        ((3.0, 9.0), (2.8, 7.0)),
        _ANYTHING | {f.office_place: 6.0, f.desk: 1.0, f.appliance: 1.0, f.board: 0.8},
        {f.office_place: 3.0, f.with_chairs: 1.0, f.chair: 1.0, f.on_floor: 0.4},
        density=0.8,
        inner_density=0.12,
    ),
    "bedroom": Family(
        ((2.8, 5.5), (2.6, 5.0)),
        _ANYTHING | {f.bed: 4.0, f.desk: 1.0, f.cabinet: 4.0},
        {f.armchair: 1.0, f.table: 1.0, f.on_floor: 1.0, f.bed: 0.5},
    ),
    "bathroom": Family(
        ((1.8, 3.5), (1.6, 3.2)),
        {f.sanitary: 6.0, f.cabinet: 1.5, f.appliance: 1.0, f.shelf: 0.5, f.on_floor: 0.7},
        {f.on_floor: 1.0, f.chair: 0.5},
        density=0.9,
    ),
    "corridor": Family(
        ((5.0, 14.0), (1.3, 2.6)),
        {
            f.cabinet: 1.5,
            f.shelf: 1.0,
            f.plant: 1.0,
            f.on_floor: 1.0,
            f.chair: 1.0,
            f.appliance: 1.0,
        },
        {f.on_floor: 1.0},
        density=0.3,
        inner_density=0.01,
    ),
    "hall": Family(
        ((6.0, 12.0), (5.0, 10.0)),
        _ANYTHING | {f.sofa: 1.5, f.desk: 1.0},
        {
            f.with_chairs: 3.0,
            f.lounge: 1.0,
            f.table: 1.0,
            f.sofa: 0.7,
            f.plant: 0.7,
            f.armchair: 1.5,
        },
        density=0.5,
    ),
}
# Bathrooms and halls are rarer in recordings than the others.
_WEIGHTS = np.array([1.3, 0.9, 1.0, 0.6, 0.4, 0.5, 0.6])


@dataclass(frozen=True)
class TrainingRoom:
    """The solids of a room.

    Attributes:
        family: a key of FAMILIES. size_m: width, depth and height. piece: all solids.
    """

    family: str
    size_m: tuple[float, float, float]
    piece: Piece


def random_room(rng: Generator, family: str | None = None) -> TrainingRoom:
    """Make a furnished room of a family, by default of a random one."""
    family = family or str(rng.choice(list(FAMILIES), p=_WEIGHTS / _WEIGHTS.sum()))
    plan = FAMILIES[family]
    width, depth = (rng.uniform(*limits) for limits in plan.size_m)
    height = rng.uniform(2.25, 3.4) if family != "hall" else rng.uniform(2.6, 5.0)
    piece = shell.surroundings((width, depth), height)
    taken: list[NDArray[np.float64]] = []
    if rng.random() < 0.25 and family != "corridor":
        piece += _bulge(rng, (width, depth), height, taken)
    for side in range(4):
        piece += _side(rng, plan, side, (width, depth, height), taken)
    piece += _inside(rng, plan, (width, depth), taken)
    piece += shell.ceiling_lamps(rng, (width, depth), height)
    return TrainingRoom(family, (width, depth, height), piece)


def _bulge(
    rng: Generator, size: tuple[float, float], height: float, taken: list[NDArray[np.float64]]
) -> Piece:
    """A corner filled by walls, which makes the plan an L, or a pillar."""
    width, depth = size
    wide, deep = rng.uniform(0.15, 0.45) * width, rng.uniform(0.15, 0.45) * depth
    x = wide / 2 if rng.random() < 0.5 else width - wide / 2
    y = deep / 2 if rng.random() < 0.5 else depth - deep / 2
    if rng.random() < 0.3:
        wide = deep = rng.uniform(0.25, 0.6)
        x, y = rng.uniform(0.2, 0.8) * width, rng.uniform(0.2, 0.8) * depth
    piece = [box("wall", (wide, deep, height), (x, y, 0.0))]
    taken.append(extent(piece))
    return piece


def _side(
    rng: Generator,
    plan: Family,
    side: int,
    size: tuple[float, float, float],
    taken: list[NDArray[np.float64]],
) -> Piece:
    """A wall with its openings, what hangs on it and what stands at it."""
    width, depth, height = size
    length = width if side % 2 == 0 else depth
    # From the frame of the wall to that of the room: back walls first, then to the right.
    at, yaw = [
        ((0.0, depth, 0.0), 0.0),
        ((width, depth, 0.0), -np.pi / 2),
        ((width, 0.0, 0.0), np.pi),
        ((0.0, 0.0, 0.0), np.pi / 2),
    ][side]
    openings = shell.openings_of(
        rng, length, height, int(rng.poisson(0.14 * length)), int(rng.poisson(0.15 * length))
    )
    fixed = shell.wall(rng, length, height, openings)
    fixed += shell.hangings(rng, length, height, openings)
    piece = placed(fixed, at, yaw)
    doors = [o for o in openings if o.name == "door"]
    for _ in range(rng.poisson(plan.density * length)):
        new = _drawn(rng, plan.along_walls)
        box_of = extent(new)
        reach = box_of[:, 0]
        if reach[1] - reach[0] > length - 0.05:
            continue
        for _ in range(_ATTEMPTS):
            x = rng.uniform(-reach[0], length - reach[1])
            gap = -abs(rng.normal(0.0, 0.03)) if rng.random() < 0.85 else -rng.uniform(0.05, 0.5)
            if any(o.left_m < x + reach[1] and o.right_m > x + reach[0] for o in doors):
                continue
            there = placed(placed(new, (x, gap, 0.0)), at, yaw)
            if _free(there, taken):
                taken.append(extent(there))
                piece += there
                break
    return piece


def _inside(
    rng: Generator, plan: Family, size: tuple[float, float], taken: list[NDArray[np.float64]]
) -> Piece:
    piece: Piece = []
    for _ in range(rng.poisson(plan.inner_density * size[0] * size[1])):
        new = _drawn(rng, plan.inside)
        for _ in range(_ATTEMPTS):
            yaw = rng.integers(4) * np.pi / 2 + (rng.normal(0, 0.3) if rng.random() < 0.4 else 0.0)
            turned = placed(new, yaw_rad=float(yaw))
            low, high = extent(turned)[:, :2]
            room_left = np.array(size) - (high - low)
            if (room_left < 0.1).any():
                break
            x, y = rng.uniform(0.0, 1.0, 2) * room_left - low
            there = placed(turned, (x, y, 0.0))
            if _free(there, taken):
                taken.append(extent(there))
                piece += there
                break
    return piece


def _drawn(rng: Generator, makers: dict[f.Maker, float]) -> Piece:
    weights = np.array(list(makers.values()))
    index = int(rng.choice(len(weights), p=weights / weights.sum()))
    return list(makers)[index](rng)


def _free(piece: Piece, taken: list[NDArray[np.float64]]) -> bool:
    """Whether the bounding box of the piece overlaps no other by more than a few centimetres."""
    low, high = extent(piece)
    return all((np.minimum(high, b[1]) - np.maximum(low, b[0]) < 0.04).any() for b in taken)
