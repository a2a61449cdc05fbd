"""Floor, wall, ceiling, surface and object, from depth alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.semantics.options import GeometricOptions
from toolkit.semantics.segmenters.geometric.labelling import (
    CEILING,
    FLOOR,
    OBJECT,
    SURFACE,
    WALL,
    label_cells,
    label_pixels,
)
from toolkit.semantics.segmenters.geometric.room import Room
from toolkit.semantics.segmenters.geometric.surface_grid import surface_grid

CLASS_NAMES: dict[int, str] = {
    FLOOR: "floor",
    WALL: "wall",
    CEILING: "ceiling",
    SURFACE: "surface",
    OBJECT: "object",
}

# Maximum number of cells across the image in which surfaces are detected.
_COLUMNS = 160


class GeometricSegmenter:
    """Labels floor, walls, ceiling, horizontal surfaces (table tops, seats) and objects.

    The up direction, the heights of floor and ceiling, and the walls are accumulated in the map
    frame, so that a table that fills the view is not labelled as floor. All poses must be in the
    same frame. A frame without a pose is labelled independently and does not change the state.
    Pixels without depth are void.

    Args:
        options: heights of the camera.
        side: the side of the images that is up.

    Raises:
        DependencyError: Open3D cannot be loaded (raised by `segment`).
    """

    def __init__(self, options: GeometricOptions | None = None, side: ImageSide = "top") -> None:
        self.class_names: Mapping[int, str] = CLASS_NAMES
        # Of the pairs of views with less than 50 % overlap, 86 % (7-Scenes RedKitchen) and 89 %
        # (four synthetic rooms) have a larger divergence; with 40 classes, 94 % are above 0.4.
        self.place_divergence = 0.05
        self._options, self._side = options or GeometricOptions(), side
        self._room = self._new_room()

    def _new_room(self) -> Room:
        return Room(self._options.camera_height_m, self._side)

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Class ids [H, W] by `CLASS_NAMES`, 0 where there is no depth."""
        grid = surface_grid(frame.depth_m, frame.camera, _COLUMNS)
        if not grid.oriented.any():
            return np.where(frame.depth_m > 0, OBJECT, 0).astype(np.int32)
        room = self._room if T_map_camera is not None else self._new_room()
        pose = np.eye(4) if T_map_camera is None else np.asarray(T_map_camera, dtype=np.float64)
        view = room.update(grid, pose)
        return label_pixels(label_cells(view, room), grid, frame.depth_m, frame.camera)

    def state(self) -> dict[str, NDArray]:
        """Return the estimated structure of the room."""
        return self._room.state()

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._room.restore(arrays)
