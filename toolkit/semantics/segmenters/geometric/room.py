"""Estimated structure of the room: up direction, floor, ceiling and walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.image_sides import ImageSide
from toolkit.semantics.segmenters.geometric.gravity import UpEstimator
from toolkit.semantics.segmenters.geometric.levelled import LevelledGrid
from toolkit.semantics.segmenters.geometric.levels import Level
from toolkit.semantics.segmenters.geometric.patches import planar_patches
from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid
from toolkit.semantics.segmenters.geometric.wall_evidence import observe
from toolkit.semantics.segmenters.geometric.walls import WallMemory

Array = NDArray[np.float64]

# Cosine of the maximum tilt of a floor or ceiling.
_LEVEL = math.cos(math.radians(20.0))
# Range of the height of the ceiling above the camera; minimum height above the floor.
_CEILING_DISTANCE_M = (0.3, 6.0)
_MIN_ROOM_HEIGHT_M = 1.9


class Room:
    """The structure of the room in the map frame, estimated over frames.

    Args:
        camera_height_m: minimum and maximum height of the camera above the floor.
        side: the side of the images that is up.

    Attributes:
        up: estimator of the up direction.
        walls: vertical planes.
    """

    def __init__(self, camera_height_m: tuple[float, float], side: ImageSide = "top") -> None:
        self._camera_height_m = camera_height_m
        self.up = UpEstimator(side)
        self._reset()

    def _reset(self) -> None:
        self._floor = Level(1, self._camera_height_m)
        self._ceiling = Level(-1, _CEILING_DISTANCE_M)
        self.walls = WallMemory()

    @property
    def floor_height_m(self) -> float | None:
        """Height of the floor, or None.

        If floor and ceiling are too close, the less often observed one of them is rejected.
        """
        wrong = self._too_close() and self._floor.seen < self._ceiling.seen
        return None if wrong else self._floor.height_m

    @property
    def ceiling_height_m(self) -> float | None:
        """Height of the ceiling, or None; rejects for instance the underside of a shelf."""
        wrong = self._too_close() and self._floor.seen >= self._ceiling.seen
        return None if wrong else self._ceiling.height_m

    def _too_close(self) -> bool:
        floor, ceiling = self._floor.height_m, self._ceiling.height_m
        return floor is not None and ceiling is not None and ceiling - floor < _MIN_ROOM_HEIGHT_M

    def update(self, grid: SurfaceGrid, T_map_camera: Array) -> LevelledGrid:
        """Integrate the surfaces of one frame; return them relative to the up direction."""
        patches = planar_patches(grid)
        R_map_camera = T_map_camera[:3, :3]
        normals = np.array([p.normal for p in patches]).reshape(-1, 3) @ R_map_camera.T
        fractions = np.array([p.cells.sum() for p in patches]) / max(int(grid.valid.sum()), 1)
        if self.up.update(normals, fractions, R_map_camera):
            self._reset()

        view = LevelledGrid(grid, T_map_camera, self.up.direction)
        heights = view.heights_m[grid.valid]
        self._floor.update(heights, view.faces(_LEVEL)[grid.valid], view.camera_height_m)
        facing_down = view.faces(-1.0, -_LEVEL)[grid.valid]
        self._ceiling.update(heights, facing_down, view.camera_height_m)
        observations = [s for s in (observe(view, patch) for patch in patches) if s is not None]
        ceiling_m = self.ceiling_height_m if self._ceiling.sure else None
        self.walls.update(observations, self.floor_height_m, ceiling_m)
        return view

    def state(self) -> dict[str, NDArray]:
        """Return the arrays that `restore` accepts."""
        return {
            **{f"up/{name}": array for name, array in self.up.state().items()},
            "floor": self._floor.state(),
            "ceiling": self._ceiling.state(),
            "walls": self.walls.state(),
        }

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self.up.restore({n[3:]: a for n, a in arrays.items() if n.startswith("up/")})
        self._floor.restore(arrays["floor"])
        self._ceiling.restore(arrays["ceiling"])
        self.walls.restore(arrays["walls"])
