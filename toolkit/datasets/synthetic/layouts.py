"""Floor plans, and the way a camera takes through them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from toolkit.datasets.synthetic.furnishing import furnish, path_reach_m
from toolkit.datasets.synthetic.furniture import Workshop
from toolkit.datasets.synthetic.parts import Part
from toolkit.datasets.synthetic.paths import WayPoint
from toolkit.datasets.synthetic.shell import Opening, RoomPlan, room_shell

EYE_M = 1.45


@dataclass(frozen=True)
class Layout:
    """Rooms and the way through them.

    Attributes:
        rooms: floor plans.
        looks: for each room the number that decides what is in it; rooms with the same
            number, size and openings are identical.
        way: what the camera passes and looks at.
        frames: how many frames a person's pace gives at 30 Hz.
    """

    rooms: tuple[RoomPlan, ...]
    looks: tuple[int, ...]
    way: tuple[WayPoint, ...]
    frames: int


def single_room() -> Layout:
    """One furnished room, 5.4 x 4.6 m; the camera walks a loop and looks around."""
    openings = (
        Opening("north", 4.2, "window"),
        Opening("south", 4.4, "door"),
    )
    plan = RoomPlan(-2.7, -2.3, 2.7, 2.3, openings, "studio")
    return Layout((plan,), (0,), tuple(round_walk(plan, 0.0, 2 * math.pi)), 300)


def round_walk(plan: RoomPlan, start_rad: float, turn_rad: float) -> list[WayPoint]:
    """A loop about the middle of a room, looking across at what stands by the walls."""
    count = max(3, round(abs(turn_rad) / math.radians(30))) + 1
    centre, reach = plan.centre_m, path_reach_m(plan)
    wall = np.array([plan.x1 - plan.x0, plan.y1 - plan.y0]) / 2
    points = []
    for number, angle in enumerate(np.linspace(start_rad, start_rad + turn_rad, count)):
        direction = np.array([math.cos(angle), math.sin(angle)])
        # Standing on the far side of the loop, the camera sees the most of the wall.
        stand = centre - reach * direction
        ahead = angle + 0.15
        target = centre + wall * [math.cos(ahead), math.sin(ahead)]
        height = EYE_M + 0.12 * math.sin(2.3 * number)
        look = 0.85 + 0.3 * math.sin(1.7 * number)
        points.append(WayPoint((*stand, height), (*target, look)))
    return points


def build_parts(layout: Layout, seed: int) -> list[Part]:
    """All surfaces of a layout."""
    parts: list[Part] = []
    for plan, look in zip(layout.rooms, layout.looks, strict=True):
        shop = Workshop(np.random.default_rng([seed, look]))
        parts += room_shell(plan, shop)
        parts += furnish(plan, shop)
    return parts


def lamp_places(layout: Layout) -> np.ndarray:
    """Middles [R, 3] of the rooms' ceiling lamps, metres."""
    return np.array([[*plan.centre_m, plan.height_m - 0.15] for plan in layout.rooms])


LAYOUTS = {"room": single_room}
