"""Waypoints of a camera that visits rooms: through doors, and around each room."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms.furnishing import path_reach_m
from toolkit.datasets.synthetic_rooms.paths import WayPoint
from toolkit.datasets.synthetic_rooms.shell import Opening, RoomPlan

EYE_M = 1.45


def visit(
    plan: RoomPlan, entry: Opening | None, leave: Opening, heading_rad: float, turn_rad: float
) -> list[WayPoint]:
    """Return the waypoints through the entry, around the room and out of another door."""
    way_points: list[WayPoint] = []
    if entry is not None:
        sill, _ = plan.door_way(entry)
        way_points.append(looking(sill, heading_rad))
    way_points += look_around(plan, heading_rad, turn_rad)
    sill, outward = plan.door_way(leave)
    out = heading_rad + turn_rad
    return [*way_points, looking(sill - 0.8 * outward, out), looking(sill, out)]


def heading(plan: RoomPlan, door: Opening, inward: bool) -> float:
    """Return the direction through a door, radians from +x."""
    _, outward = plan.door_way(door)
    x, y = -outward if inward else outward
    return math.atan2(y, x)


def looking(stand: NDArray | tuple[float, float], heading_rad: float) -> WayPoint:
    """Return a waypoint that looks straight ahead and slightly down."""
    x, y = stand
    ahead = (x + 2 * math.cos(heading_rad), y + 2 * math.sin(heading_rad), EYE_M - 0.25)
    return WayPoint((float(x), float(y), EYE_M), ahead)


def look_around(plan: RoomPlan, start_rad: float, turn_rad: float) -> list[WayPoint]:
    """Return a loop around the centre of a room that looks across at the opposite walls."""
    count = max(2, round(abs(turn_rad) / math.radians(30))) + 1
    centre, reach = np.array(plan.centre_m), path_reach_m(plan)
    wall = np.array(plan.size_m) / 2
    points = []
    for number, angle in enumerate(np.linspace(start_rad, start_rad + turn_rad, count)):
        direction = np.array([math.cos(angle), math.sin(angle)])
        # From the far side of the loop, the camera sees the largest part of the wall.
        x, y = centre - reach * direction
        target_x, target_y = centre + wall * direction
        height = EYE_M + 0.1 * math.sin(2.3 * number)
        look = 0.85 + 0.25 * math.sin(1.7 * number)
        points.append(WayPoint((x, y, height), (target_x, target_y, look)))
    return points
