"""Floor plans as pictures, with rooms and paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError
from toolkit.exports.floors import required_floors
from toolkit.exports.mapped_scene import MappedScene, map_scene
from toolkit.exports.options import GridOptions, ObjectGraphOptions, PlanOptions
from toolkit.exports.selection import SelectedGaussians
from toolkit.io.images import write_png
from toolkit.io.occupancy import OccupancyGrid
from toolkit.scene.graph.floor_plan import (
    PlanDrawing,
    PlanEdge,
    PlanNode,
    draw_floor_plans,
    floor_plans,
    total_areas,
)
from toolkit.scene.graph.paths import FreePath
from toolkit.semantics.palette import Palette


@dataclass(frozen=True)
class WrittenPlan:
    """What a floor plan shows: number of classes, and of rooms and a path if they were drawn."""

    classes: int
    rooms: int | None
    path: FreePath | None

    def __str__(self) -> str:
        text = f"a floor plan with {self.classes} classes"
        if self.rooms is not None:
            text += f" and {self.rooms} rooms"
        if self.path is not None:
            text += f", and a path of {self.path.length_m:.2f} m, {self.path.width_m:.2f} m wide,"
        return text


def export_floor_plan(
    path: Path,
    selection: SelectedGaussians,
    options: PlanOptions,
    objects: ObjectGraphOptions,
    floor: Sequence[str] = (),
    grid: GridOptions | None = None,
) -> WrittenPlan:
    """Write the floor plan of the selected Gaussians as a PNG.

    Raises:
        ToolkitError: the map has no labels, no floor was found, there is no such object or no free
            path, or the file cannot be written.
    """
    opaque = selection.opaque()
    labelled = opaque.labelled()
    floors = required_floors(selection, floor)
    palette = Palette(labelled.taxonomy)
    cameras_m = selection.run.trajectory.positions_m
    radii_m = opaque.gaussians.radii_seen_m(floors.ground.up)
    plans = floor_plans(labelled, radii_m, floors, cameras_m, palette)
    found, rooms, drawings = None, None, []
    if options.rooms or options.graph or options.path is not None:
        scene = map_scene(selection, objects, floor, grid)
        found = _path(scene, options)
        rooms = len(scene.building.rooms)
        drawings = _drawing(scene, found, options.graph).by_storey(floors)
    names = selection.run.length_names
    write_png(path, draw_floor_plans(plans, palette, names=names, drawings=drawings))
    return WrittenPlan(len(total_areas(plans)), rooms, found)


def _path(scene: MappedScene, options: PlanOptions) -> FreePath | None:
    if options.path is None:
        return None
    for number in options.path:
        if not 0 <= number < len(scene.objects):
            raise SettingsError(
                f"--plan.path: there is no object {number}; the objects are 0 to "
                f"{len(scene.objects) - 1}, as in the scene graph"
            )
    start, goal = (scene.place(number) for number in options.path)
    return scene.path(start, goal, options.width_m)


def _drawing(scene: MappedScene, path: FreePath | None, graph: bool) -> PlanDrawing:
    rooms, spaces = scene.building.rooms, scene.building.spaces
    outlines = [
        _outlines(spaces[storey].rooms.numbers == room, spaces[storey].grid)
        for storey, room in rooms.order
    ]
    centres_m = [
        scene.building.point(storey, rooms.maps[storey].centres[room])
        for storey, room in rooms.order
    ]
    doors_m = [
        scene.building.point(storey, door.cell)
        for storey, own in enumerate(rooms.maps)
        for door in own.doors
    ]
    return PlanDrawing(
        [(f"room {k + 1}", outline) for k, outline in enumerate(outlines)],
        np.array(centres_m).reshape(-1, 3),
        np.array(doors_m).reshape(-1, 3),
        np.empty((0, 3)) if path is None else path.points_m,
        *(_graph(scene) if graph else ((), ())),
    )


def _graph(scene: MappedScene) -> tuple[list[PlanNode], list[PlanEdge]]:
    """The objects in rooms, and the relations between them."""
    nodes = {
        number: PlanNode(str(number), found.box.centre_m)
        for number, found in enumerate(scene.objects)
        if not scene.enclosing[number]
    }
    edges = [
        PlanEdge(r.kind, nodes[r.source].centre_m, nodes[r.target].centre_m)
        for r in scene.relations
        if r.source in nodes and r.target in nodes
    ]
    return list(nodes.values()), edges


def _outlines(room: NDArray[np.bool_], grid: OccupancyGrid) -> list[NDArray[np.float64]]:
    contours, _ = cv2.findContours(
        room.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    return [grid.points_of(contour[:, 0, ::-1].astype(np.intp)) for contour in contours]
