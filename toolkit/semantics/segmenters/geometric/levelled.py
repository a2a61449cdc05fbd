"""A surface grid with a pose and a known up direction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Maximum distance of a point from its plane: constant part in metres, and fraction of its depth.
_DISTANCE_M, _DISTANCE_FRACTION = 0.04, 0.01


@dataclass(frozen=True)
class LevelledGrid:
    """Heights and orientations of a grid's cells relative to the up direction.

    Attributes:
        grid: the cells in camera coordinates.
        T_map_camera: [4, 4] pose of the camera.
        up: [3] unit vector in the map frame.
    """

    grid: SurfaceGrid
    T_map_camera: Array
    up: Array

    @cached_property
    def up_camera(self) -> Array:
        """The up direction in camera coordinates."""
        return np.asarray(self.T_map_camera[:3, :3].T @ self.up)

    @cached_property
    def camera_height_m(self) -> float:
        """Height of the camera along up from the map's origin."""
        return float(self.up @ self.T_map_camera[:3, 3])

    @cached_property
    def heights_m(self) -> Image:
        """Heights [h, w] of the cells along up from the map's origin."""
        return self.along(self.up)

    @cached_property
    def slope(self) -> Image:
        """Cosine [h, w] of the angle between normal and up: 1 faces up, -1 down, 0 is vertical."""
        return self.facing(self.up)

    @cached_property
    def tolerance_m(self) -> Image:
        """Maximum distance [h, w] of a point from its plane."""
        return np.float32(_DISTANCE_M) + np.float32(_DISTANCE_FRACTION) * self.grid.depth_m

    def faces(self, lowest: float, highest: float = 1.0) -> Mask:
        """Return the mask [h, w] of cells whose `slope` is between two bounds."""
        return self.grid.oriented & (self.slope >= lowest) & (self.slope <= highest)

    def along(self, direction: Array) -> Image:
        """Return the coordinates [h, w] of the cells along a direction [3] of the map frame (m)."""
        direction_camera = (self.T_map_camera[:3, :3].T @ direction).astype(np.float32)
        start = np.float32(direction @ self.T_map_camera[:3, 3])
        return np.asarray(self.grid.points @ direction_camera + start, dtype=np.float32)

    def facing(self, direction: Array) -> Image:
        """Return the cosine [h, w] between the normals and a direction [3] of the map frame."""
        direction_camera = (self.T_map_camera[:3, :3].T @ direction).astype(np.float32)
        return np.asarray(self.grid.normals @ direction_camera, dtype=np.float32)
