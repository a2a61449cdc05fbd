"""The objects, relations, rooms and free floor of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.exports.floors import required_ground
from toolkit.exports.free_space import FreeSpace, free_space
from toolkit.exports.options import GridOptions, ObjectGraphOptions
from toolkit.exports.selection import SelectedGaussians
from toolkit.runs.visibility import KeyframeViews, keyframe_views
from toolkit.semantics.boxes import Ground
from toolkit.semantics.colour_names import colour_name
from toolkit.semantics.options import ObjectOptions
from toolkit.semantics.paths import Place
from toolkit.semantics.query import (
    FLOOR_NAMES,
    LabelledMap,
    SceneObject,
)
from toolkit.semantics.relations import Relation, RelationOptions, relations
from toolkit.semantics.roles import Roles
from toolkit.semantics.rooms import RoomOptions
from toolkit.semantics.scene import SceneReader

# A keyframe sees an object if it sees this share of its points and this number of them.
_SEEN_SHARE, _SEEN_POINTS, _SAMPLES = 0.2, 3, 64
# What encloses rooms is part of each room that contains this share of it.
_PART_SHARE = 0.05
_DECIMALS = 4


@dataclass(frozen=True)
class MappedScene:
    """The objects of a map and where they are.

    Attributes:
        selection: the Gaussians.
        map: their labels.
        ground: plane of the floor.
        objects: the objects, largest first.
        enclosing: whether each object is part of rooms (walls, floors, doors, ...).
        relations: relations between objects, by their numbers.
        space: free floor and rooms.
        views: what the keyframes see.
        floor: names of the floor.
        grid: options of the occupancy grid.
    """

    selection: SelectedGaussians
    map: LabelledMap
    ground: Ground
    objects: list[SceneObject]
    enclosing: list[bool]
    relations: list[Relation]
    space: FreeSpace
    views: KeyframeViews
    floor: Sequence[str]
    grid: GridOptions

    def points_m(self, number: int) -> NDArray[np.float64]:
        """Return the centres [n, 3] of the Gaussians of an object."""
        return self.map.means_m[self.objects[number].index]

    def rooms_of(self, number: int) -> list[int]:
        """Return the indices of the rooms of an object: one, or all that it encloses."""
        shares = self.space.rooms_of(self.points_m(number))
        if self.enclosing[number]:
            return sorted(room for room, share in shares.items() if share >= _PART_SHARE)
        return [max(shares, key=lambda k: shares[k])] if shares else []

    def place(self, number: int) -> Place:
        """Return an object as the end of a path, which is in its room."""
        rooms = self.rooms_of(number)
        within = np.isin(self.space.rooms.numbers, rooms) if rooms else None
        name = f"{self.objects[number].node.name} {number}"
        return Place(name, self.space.grid.mask_of(self.points_m(number)), within)

    def describe(self, number: int) -> dict[str, Any]:
        """Return class, box, colour, rooms and the frames that see an object as JSON values."""
        found = self.objects[number]
        rgb, areas = self._surface
        return {
            **self._reader.describe(found),
            "colour": colour_name(rgb[found.index], areas[found.index]),
            "rooms": [room + 1 for room in self.rooms_of(number)],
            **self._seen[number],
        }

    def describe_room(self, number: int) -> dict[str, Any]:
        """Return area, place and doors of a room as JSON values."""
        rooms = self.space.rooms
        cells = np.argwhere(rooms.numbers == number)
        flat = cells * self.space.grid.cell_m
        return {
            "name": f"room {number + 1}",
            "number": number + 1,
            "area_m2": round(rooms.areas_m2[number], 2),
            "size_m": (np.ptp(flat, axis=0)[::-1] + self.space.grid.cell_m).round(2).tolist(),
            "centre_m": self._point(rooms.centres[number]),
            "doors": [
                {
                    "to_room": 1 + (set(door.rooms) - {number}).pop(),
                    "width_m": round(door.width_m, 2),
                    "place_m": self._point(door.cell),
                }
                for door in rooms.doors
                if number in door.rooms
            ],
        }

    def _point(self, cell: tuple[int, int]) -> list[float]:
        return self.space.grid.points_of(np.array([cell]))[0].round(_DECIMALS).tolist()

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
        samples = [
            self.points_m(k)[:: max(1, len(o) // _SAMPLES)] for k, o in enumerate(self.objects)
        ]
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
    ground = required_ground(selection, floor)
    object_options = ObjectOptions(options.link_m, options.min_gaussians)
    objects = labelled.objects(None, ground, object_options)
    known = Roles(labelled.taxonomy, floor or FLOOR_NAMES)
    roles = [known.of(found.node.path) for found in objects]
    grid = grid or GridOptions()
    views = keyframe_views(selection.run)
    space = free_space(selection, ground, views, grid, RoomOptions(options.max_door_m))
    cameras_m = np.array([f.T_map_camera[:3, 3] for f in selection.run.tracked]).reshape(-1, 3)
    related = relations(
        [labelled.means_m[o.index] for o in objects],
        ground,
        roles,
        RelationOptions(options.contact_m, options.next_to_m, options.facing_m),
        cameras_m,
    )
    return MappedScene(
        selection,
        labelled,
        ground,
        objects,
        [role != "object" for role in roles],
        related,
        space,
        views,
        floor or FLOOR_NAMES,
        grid,
    )
