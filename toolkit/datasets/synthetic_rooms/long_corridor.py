"""A corridor whose images hardly determine where the camera is, and a hall at its end.

Its walls are white panels with thin joints. Doors, joints and lamps repeat at equal distances, and
a part of the walls has no joints at all.
"""

from __future__ import annotations

import math

import numpy as np

from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.paths import WayPoint
from toolkit.datasets.synthetic_rooms.shell import WALL_HALF_M, Opening, RoomPlan, Side
from toolkit.datasets.synthetic_rooms.visits import looking, visit

# Doors and lamps repeat after six panels; the corridor has four repetitions.
PANEL_M, JOINT_M = 0.625, 0.005
DOOR_PITCH_M = 6 * PANEL_M
LENGTH_M, WIDTH_M = 4 * DOOR_PITCH_M, 2.0
BLANK_PANELS = 3  # without joints, in the middle
_HALL_M = 4.2
_WHITE, _DARK = (0.77, 0.77, 0.76), (0.22, 0.22, 0.23)
_FLOOR, _GROUT = (0.56, 0.57, 0.56), (0.4, 0.4, 0.4)
_CEILING, _SHADE = (0.74, 0.74, 0.73), (0.5, 0.5, 0.5)


def corridor_and_hall() -> tuple[RoomPlan, RoomPlan]:
    """Create the corridor along x, and the furnished hall in the east."""
    sides: tuple[Side, Side] = ("north", "south")
    doors = [
        Opening(side, (number + 0.5) * DOOR_PITCH_M, "door")
        for side in sides
        for number in range(4)
    ]
    way = Opening("east", WIDTH_M / 2, "passage")
    half_m = BLANK_PANELS * PANEL_M / 2
    corridor = RoomPlan(
        (0.0, 0.0),
        (LENGTH_M, WIDTH_M),
        (*doors, way),
        "bare",
        wall=tx.cladding(
            _WHITE,
            _DARK,
            (PANEL_M, 1.3),
            JOINT_M,
            blank_m=(LENGTH_M / 2 - half_m, LENGTH_M / 2 + half_m),
        ),
        floor=tx.cladding(_FLOOR, _GROUT, (PANEL_M, PANEL_M), 0.004),
        ceiling=tx.cladding(_CEILING, _SHADE, (PANEL_M, PANEL_M), 0.008),
        lamps=4,
    )
    openings = (Opening("west", _HALL_M / 2, "passage"), Opening("north", _HALL_M / 2, "window"))
    x = LENGTH_M / 2 + 2 * WALL_HALF_M + _HALL_M / 2
    return corridor, RoomPlan((x, 0.0), (_HALL_M, _HALL_M), openings, "living")


def there_and_back(
    corridor: RoomPlan, hall: RoomPlan, side_turn_rad: float
) -> tuple[WayPoint, ...]:
    """Return the waypoints along the corridor, around the hall, and back.

    Args:
        corridor, hall: of `corridor_and_hall`.
        side_turn_rad: largest angle between the walk and the view. The camera looks to the north
            in the blank middle and to the south between the next doors, both ways.
    """
    x0, _, x1, _ = corridor.bounds_m
    y = corridor.centre_m[1]
    stands = np.linspace(x0 + 0.9, x1 - 1.2, 22)
    turns = side_turn_rad * np.cos(math.pi * stands / DOOR_PITCH_M)
    east = [looking((x, y), turn) for x, turn in zip(stands, turns, strict=True)]
    west = [looking((x, y), math.pi - turn) for x, turn in zip(stands, turns, strict=True)]
    door = hall.openings[0]
    # The last views show the wall at the end.
    return (*east, *visit(hall, door, door, 0.0, math.pi), *west[:1:-1])
