"""The objects, relations, storeys, rooms and free floor of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.thinning import thinned
from toolkit.exports.building import Building, find_building
from toolkit.exports.floors import required_floors
from toolkit.exports.options import GridOptions, ObjectGraphOptions
from toolkit.exports.selection import SelectedGaussians
from toolkit.runs.maps.visibility import KeyframeViews, keyframe_views
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.node_link import rooms_of_object
from toolkit.scene.graph.paths import FreePath, NoPathError, PathFinder, Place
from toolkit.scene.graph.relations import Relation, RelationOptions
from toolkit.scene.graph.roles import Roles
from toolkit.scene.graph.rooms import RoomOptions
from toolkit.scene.graph.scene import SceneReader
from toolkit.scene.graph.scene_relations import SceneRelations
from toolkit.scene.query import (
    FLOOR_NAMES,
    LabelledMap,
    SceneObject,
)
from toolkit.semantics.colour_names import colour_name
from toolkit.semantics.options import ObjectOptions

# A keyframe sees an object if it sees this share of its points and this number of them.
_SEEN_SHARE, _SEEN_POINTS, _SAMPLES = 0.2, 3, 64


@dataclass(frozen=True)
class MappedScene:
    """The objects of a map and where they are.

    Attributes:
        selection: the Gaussians.
        map: their labels.
        objects: the objects, largest first.
        enclosing: whether each object is part of rooms (walls, floors, doors, ...).
        storeys: indices of the storeys of each object: one, or all into which a structure reaches.
        relations: relations between objects, by their numbers.
        building: free floor and rooms of each storey.
        views: what the keyframes see.
        floor: names of the floor.
        grid: options of the occupancy grid.
    """

    selection: SelectedGaussians
    map: LabelledMap
    objects: list[SceneObject]
    enclosing: list[bool]
    storeys: list[range]
    relations: list[Relation]
    building: Building
    views: KeyframeViews
    floor: Sequence[str]
    grid: GridOptions

    @property
    def ground(self) -> Ground:
        """Plane of the floor, of the lowest storey."""
        return self.building.floors.ground

    def rooms_of(self, number: int) -> list[int]:
        """Return the indices of the rooms of an object: one, or all that it encloses."""
        return rooms_of_object(
            self.building,
            self.objects[number].points_m,
            self.storeys[number],
            self.enclosing[number],
        )

    def place(self, number: int) -> Place:
        """Return an object as the end of a path, which is in its room."""
        rooms, storey = self.rooms_of(number), self.storeys[number][0]
        within = np.isin(self.building.rooms.numbers_of(storey), rooms) if rooms else None
        name = f"{self.objects[number].node.name} {number}"
        footprint = self.building.spaces[storey].grid.mask_of(self.objects[number].points_m)
        return Place(name, footprint, within, storey)

    def place_at(self, point_m: NDArray[np.float64], name: str) -> Place:
        """Return a point [3] of the map as the end of a path, on the storey at its height.

        Raises:
            NoPathError: it is outside the map.
        """
        storey = int(self.building.floors.at(point_m[None])[0])
        grid = self.building.spaces[storey].grid
        if not grid.contains(point_m[None])[0]:
            raise NoPathError(f"{name} is outside the map; choose another place")
        return Place(name, grid.mask_of(point_m[None]), None, storey)

    def path(self, start: Place, goal: Place, width_m: float) -> FreePath:
        """Return the shortest free path of a minimum width between places of one storey.

        Raises:
            NoPathError: there is none, or the places are on different storeys.
        """
        if start.storey != goal.storey:
            ends = " and ".join(f"{p.name} is on storey {p.storey + 1}" for p in (start, goal))
            raise NoPathError(
                f"no path: {ends}; paths stay on one storey, since stairs are not known: choose "
                "two places on one storey"
            )
        return self._finders[start.storey].shortest(start, goal, width_m)

    def describe(self, number: int) -> dict[str, Any]:
        """Return class, box, colour, rooms and the frames that see an object as JSON values."""
        found = self.objects[number]
        rgb, areas = self._surface
        return {
            **self._reader.describe(found),
            "colour": colour_name(rgb[found.index], areas[found.index]),
            "rooms": [room + 1 for room in self.rooms_of(number)],
            "storey": self.storeys[number][0] + 1,
            **self._seen[number],
        }

    @cached_property
    def _finders(self) -> list[PathFinder]:
        return [PathFinder(space.grid) for space in self.building.spaces]

    @cached_property
    def _reader(self) -> SceneReader:
        viewpoint_m = self.selection.run.tracked[0].T_map_camera[:3, 3]
        return SceneReader(self.map, ObjectOptions(), viewpoint_m, self.floor, self.ground)

    @cached_property
    def _surface(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colours [N, 3] in [0, 1] and relative areas [N] of the Gaussians."""
        gaussians = self.selection.gaussians
        return gaussians.colours.numpy(), gaussians.radii_m.numpy() ** 2

    @cached_property
    def _seen(self) -> list[dict[str, Any]]:
        """First and last keyframe that see each object, and their number."""
        samples = [thinned(o.points_m, _SAMPLES) for o in self.objects]
        owner = np.repeat(np.arange(len(samples)), [len(s) for s in samples])
        sizes = np.bincount(owner, minlength=len(samples))
        seen = np.zeros((len(self.views), len(samples)), bool)
        for view in range(len(self.views)):
            surface = self.views.sight(view, np.concatenate(samples)).surface
            count = np.bincount(owner, weights=surface, minlength=len(samples))
            seen[view] = count >= np.maximum(_SEEN_SHARE * sizes, _SEEN_POINTS)
        rows = []
        for column in seen.T:
            frames = [self.views.frames[k] for k in np.flatnonzero(column)]
            first, last = (frames[0], frames[-1]) if frames else (None, None)
            rows.append({"first_seen": first, "last_seen": last, "keyframes": len(frames)})
        return rows


def map_scene(
    selection: SelectedGaussians,
    options: ObjectGraphOptions,
    floor: Sequence[str] = (),
    grid: GridOptions | None = None,
) -> MappedScene:
    """Return the objects of the selected Gaussians, their relations and rooms.

    Raises:
        ToolkitError: the map has no labels, no floor was found, or the grid is too large.
    """
    labelled = selection.labelled()
    floors = required_floors(selection, floor)
    object_options = ObjectOptions(options.link_m, options.min_gaussians)
    objects = labelled.objects(None, floors.ground, object_options)
    known = Roles(labelled.taxonomy, floor or FLOOR_NAMES)
    roles = [known.of(found.node.path) for found in objects]
    storeys = [floors.of_object(found.points_m, known.kind(found.node.path)) for found in objects]
    grid = grid or GridOptions()
    views = keyframe_views(selection.run)
    building = find_building(selection, floors, views, grid, RoomOptions(options.max_door_m))
    cameras_m = np.array([f.T_map_camera[:3, 3] for f in selection.run.tracked]).reshape(-1, 3)
    relation_options = RelationOptions(options.contact_m, options.next_to_m, options.facing_m)
    related = SceneRelations(lambda k: objects[k].points_m, relation_options)
    for number, role in enumerate(roles):
        related.changed(number, role)
    related.update(floors, cameras_m)
    return MappedScene(
        selection,
        labelled,
        objects,
        [role != "object" for role in roles],
        storeys,
        related.relations(),
        building,
        views,
        floor or FLOOR_NAMES,
        grid,
    )
