"""Options of exports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from toolkit.base.options import PositiveFloat, PositiveInt
from toolkit.io import suffixes

# Suffixes of the file of each format; none if it is a folder. Of the formats of a suffix, the first
# one is its default.
FORMATS: dict[str, tuple[str, ...]] = {
    "gltf": suffixes.GLTF_SUFFIXES,
    "splats": suffixes.SPLAT_SUFFIXES,
    "mesh": suffixes.MESH_SUFFIXES,
    "points": suffixes.POINT_SUFFIXES,
    "labelled-points": suffixes.LABELLED_SUFFIXES,
    "colmap-text": (),
    "colmap-binary": (),
    "nerfstudio": (),
    "occupancy-grid": (".yaml",),
    "scene-graph": (".json", ".jsonld", ".graphml"),
    "floor-plan": (".png",),
    "trajectory": (".txt", ".tum"),
    "viewer": (".html",),
}
if TYPE_CHECKING:
    ExportFormat = str
else:
    ExportFormat = Literal[tuple(FORMATS)]


def format_of(suffix: str) -> ExportFormat:
    """The format of a file by its suffix, splats if no format has it."""
    return next((name for name, known in FORMATS.items() if suffix in known), "splats")


@dataclass(frozen=True)
class GridOptions:
    """Occupancy grids and floor plans."""

    cell_m: PositiveFloat = 0.05
    """Edge of a cell of an occupancy grid, in metres. A pixel of a floor plan is 0.02 m."""
    min_height_m: PositiveFloat = 0.1
    """Minimum height above the floor of obstacles, in metres."""
    max_height_m: PositiveFloat = 1.8
    """Maximum height above the floor of obstacles, in metres: the height of the robot."""
    min_gaussians: PositiveInt = 3
    """Minimum number of Gaussians of an obstacle in a cell."""


@dataclass(frozen=True)
class PlanOptions:
    """What is drawn over floor plans."""

    rooms: bool = False
    """Draw the outlines, numbers and doors of rooms."""
    graph: bool = False
    """Draw the objects of the scene graph with their numbers and relations, and rooms."""
    path: tuple[int, int] | None = None
    """Draw the shortest free path between two objects, by their numbers in the scene graph, and
    rooms."""
    width_m: PositiveFloat = 0.6
    """Minimum free width of the path, in metres."""


@dataclass(frozen=True)
class ObjectGraphOptions:
    """Objects and relations of scene graphs."""

    link_m: PositiveFloat = 0.06
    """Maximum distance between neighbouring Gaussians of one object, in metres."""
    min_gaussians: PositiveInt = 30
    """Minimum number of Gaussians of an object."""
    contact_m: PositiveFloat = 0.08
    """Maximum vertical gap between an object and the one that supports it, in metres."""
    next_to_m: PositiveFloat = 0.3
    """Maximum distance between objects that are next to each other, in metres."""
    facing_m: PositiveFloat = 2.5
    """Maximum distance from a seat or screen to the object that it faces, in metres."""
    max_door_m: PositiveFloat = 1.4
    """Maximum width of a passage that separates two rooms, in metres."""
