"""A house of two storeys with different rooms, the upper one beyond the lower one on a side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from labelled_room import sheet
from layout_run import write_run

from toolkit.datasets.synthetic_rooms.paths import look_at
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS

STOREY_M, _CEILING_M = 2.8, 2.5
LENGTH_M, WIDTH_M = 8.0, 5.0
# The wall of the lower storey is at x = 3 with a door at y, that of the upper one at y = 2.
_SPLITS_M, _DOORS_M, DOOR_M = (3.0, 2.0), (1.0, 6.0), 0.9
# Places in the rooms, in the order in which the camera visits them: lower, upper, upper, lower.
VISITED = ((1.5, 1.5, 0), (4.0, 2.5, 1), (4.0, 5.0, 1), (5.5, 2.5, 0))
AREAS_M2 = (15.0, 16.0, 24.0, 25.0)
_SPACING_M = 0.12
# The upper storey begins at y.
_SHIFT_M = 1.5


def points_of(storey: int) -> dict[str, np.ndarray]:
    """Points [N, 3] of each class of a storey; z is up."""
    x, y, z = (LENGTH_M, 0, 0), (0, WIDTH_M, 0), (0, 0, _CEILING_M)
    outer = [
        _sheet((0, 0, 0), x, z),
        _sheet((0, WIDTH_M, 0), x, z),
        _sheet((0, 0, 0), y, z),
        _sheet((LENGTH_M, 0, 0), y, z),
    ]
    at, door = _SPLITS_M[storey], _DOORS_M[storey]
    inner = [_sheet((at, a, 0), (0, b - a, 0), z) for a, b in ((0, door), (door + DOOR_M, WIDTH_M))]
    if storey == 1:
        ends = ((0, door), (door + DOOR_M, LENGTH_M))
        inner = [_sheet((a, at, 0), (b - a, 0, 0), z) for a, b in ends]
    parts = {
        "floor": [_sheet((0, 0, 0), x, y)],
        "ceiling": [_sheet((0, 0, _CEILING_M), x, y)],
        "wall": [*outer, *inner],
        # In the second and the fourth visited room.
        "table": [_box((6.4, 0.5, 0.0), (1.0, 0.6, 0.7))],
        # Below the ceiling: nearer to the upper floor than to the lower one.
        "lamp": [_box((1.0, 3.5, 2.2), (0.3, 0.3, 0.25))],
    }
    offset = np.array([0.0, storey * _SHIFT_M, storey * STOREY_M])
    return {name: np.concatenate(found) + offset for name, found in parts.items()}


def house_run(folder: Path, storeys: Sequence[int] = (0, 1)) -> Path:
    """Write the folder of a run that has mapped some storeys."""
    parts = [part for storey in storeys for part in points_of(storey).items()]
    ids = [np.full(len(points), CLASS_IDS[name], np.int32) for name, points in parts]
    points = np.concatenate([points for _, points in parts])
    return write_run(folder, points, np.concatenate(ids), cameras(), spacing_m=_SPACING_M)


def cameras() -> np.ndarray:
    """T_world_camera [K, 4, 4] in the visited rooms, looking around in each."""
    poses = []
    for x, y, storey in VISITED:
        eye = np.array([x, y, storey * STOREY_M + 1.5])
        for angle in np.linspace(0.0, 2 * np.pi, 6, endpoint=False):
            target = eye + np.array([np.cos(angle), np.sin(angle), -0.4])
            poses.append(look_at(eye, target))
    return np.stack(poses)


def _sheet(corner: tuple, one: tuple, other: tuple) -> np.ndarray:
    return sheet(corner, one, other, _SPACING_M)


def _box(corner: tuple, size: tuple) -> np.ndarray:
    """The upper and four upright sides of a box."""
    (a, b, c), (x, y, z) = corner, size
    return np.concatenate(
        [
            sheet((a, b, c + z), (x, 0, 0), (0, y, 0)),
            sheet((a, b, c), (x, 0, 0), (0, 0, z)),
            sheet((a, b + y, c), (x, 0, 0), (0, 0, z)),
            sheet((a, b, c), (0, y, 0), (0, 0, z)),
            sheet((a + x, b, c), (0, y, 0), (0, 0, z)),
        ]
    )
