"""Floors of a growing scene: which they are, and whether they have moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.storeys import Floors, find_storeys, lowest_floor

Array = NDArray[np.float64]

# Floors that differ by less (radians and metres) are the same.
_TILT, _SHIFT_M = 0.01, 0.02


def fitted_floors(floor_m: Array, cameras_m: Array) -> Floors | None:
    """Fit the floors of all storeys to points [N, 3]; None if they do not form planes.

    Args:
        floor_m: points of floors.
        cameras_m: [P, 3] positions of the camera, above the floors.
    """
    ground = lowest_floor(floor_m, cameras_m)
    if ground is None:
        return None
    return Floors(ground, find_storeys(floor_m @ ground.up, ground.height_m))


def same_floors(one: Floors, other: Floors) -> bool:
    """Return whether bodies along the axes of some floors can be kept."""
    tilt = float(np.linalg.norm(one.ground.up - other.ground.up))
    shift_m = abs(one.ground.height_m - other.ground.height_m)
    return tilt <= _TILT and shift_m <= _SHIFT_M and len(one.storeys) == len(other.storeys)
