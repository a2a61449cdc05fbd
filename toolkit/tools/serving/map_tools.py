"""What assistants can ask about a finished run: objects, measures, views, paths and changes.

Answers are JSON values of bounded size; names of classes come from data and are escaped.
"""

from __future__ import annotations

import html
import re
from collections import Counter
from dataclasses import replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.geometry.thinning import thinned
from toolkit.exports.map_changes import changes_between, require_metres
from toolkit.exports.mapped_scene import MappedScene, map_scene
from toolkit.exports.options import ObjectGraphOptions
from toolkit.exports.selection import select
from toolkit.runs.maps.registering import relative_pose
from toolkit.scene.graph.measures import free_width_m, surface_distance
from toolkit.scene.graph.paths import Place
from toolkit.semantics.colour_names import COLOUR_NAMES
from toolkit.semantics.lexicon.matching import match
from toolkit.tools.serving.options import EarlierRun
from toolkit.tools.serving.served_run import NotAvailableError, ServedRun

Array = NDArray[np.float64]
Point = tuple[float, float, float]

MAX_RESULTS = 50
_MAX_NAME, _MAX_EXPLANATION = 100, 400
_MAX_POINTS = 100
_MIN_SIGHT_M = 1e-3
_REMEDY = "call describe: objects_by_name lists the names"
# Control characters (ANSI sequences begin with one) and those that change the direction of text.
_UNSAFE = re.compile("[\u0000-\u001f\u007f-\u009f\u200b-\u200f\u2028-\u202e\u2066-\u2069]")


class MapTools:
    """Answers about a run. One thread may call them at a time.

    Args:
        run: the run.
        earlier: an earlier run of the place, or None.
    """

    def __init__(self, run: ServedRun, earlier: EarlierRun | None = None) -> None:
        self._run = run
        self._earlier = earlier

    def find(
        self, name: str | None, colour: str | None, room: int | None, first: int, limit: int
    ) -> dict[str, Any]:
        """Return the objects of a class or group, or all, largest first.

        Args:
            name: class, group or noun (`lexicon.matching`), None for all.
            colour: only objects of this colour.
            room: only objects of this room, from 1.
            first: number of results to skip.
            limit: maximum number of results.

        Raises:
            ToolkitError: the name, colour or room does not exist.
        """
        meant = None if name is None else match(name, self._scene.map.taxonomy, remedy=_REMEDY)
        paths = [()] if meant is None else [node.path for node in meant.nodes]
        if colour is not None and colour not in COLOUR_NAMES:
            raise SettingsError(f"colour must be one of {', '.join(COLOUR_NAMES)}")
        if room is not None:
            self._check_room(room)
        found = [
            item
            for number, item in enumerate(self._objects)
            if any(self._scene.objects[number].node.path[: len(path)] == path for path in paths)
            and colour in (None, item["colour"])
            and (room is None or room in item["rooms"])
        ]
        answer: dict[str, Any] = {"total": len(found), "objects": found[first : first + limit]}
        if meant is not None and meant.explanation is not None:
            answer["explanation"] = shown(meant.explanation, _MAX_EXPLANATION)
        if not found:
            answer["hint"] = "nothing matches; call find without arguments to list all objects"
        return answer

    def describe(self, number: int | None, room: int | None) -> dict[str, Any]:
        """Return one object with its relations, one room with its objects, or an overview."""
        if number is not None and room is not None:
            raise SettingsError("give object_id or room, not both")
        if number is not None:
            return self._describe_object(self._checked(number))
        scene = self._scene
        if room is not None:
            self._check_room(room)
            inside = [o for o in self._objects if room in o["rooms"]]
            return {**scene.building.describe(room - 1), **_counted(inside)}
        rooms = [scene.building.describe(k) for k in range(len(scene.building.rooms))]
        storeys = scene.building.floors.storeys
        return {
            "run": shown(self._run.name),
            "unit": "metres" if scene.selection.run.metric else "arbitrary unit of length",
            "up": scene.ground.up.round(6).tolist(),
            **({"storeys": len(storeys)} if len(storeys) > 1 else {}),
            "rooms": rooms[:MAX_RESULTS],
            **_counted(self._objects),
        }

    def measure(self, number: int, other: int | None) -> dict[str, Any]:
        """Return the size of an object, or the distance and free width between two objects."""
        scene = self._scene
        if other is None:
            described = scene.describe(self._checked(number))
            return {
                **self._objects[number],
                "floor_area_m2": described["floor_area_m2"],
                "axes": described["box"]["axes"],
            }
        a, b = (scene.objects[self._checked(k)].points_m for k in (number, other))
        distance = surface_distance(a, b)
        grid = scene.grid
        heights_m = grid.min_height_m, grid.max_height_m
        storey, width_m = scene.storeys[number][0], None
        if storey == scene.storeys[other][0]:
            ground, space = scene.building.floors.of(storey), scene.building.spaces[storey]
            width_m = free_width_m(a, b, ground, space.grid, heights_m)
        return {
            "objects": [self._objects[number], self._objects[other]],
            "distance_m": round(distance.distance_m, 3),
            "nearest_m": distance.nearest_m.round(3).tolist(),
            "between_centres_m": round(distance.centres_m, 3),
            "free_width_m": None if width_m is None else round(width_m, 3),
        }

    def path(self, start: int | Point, goal: int | Point, width_m: float) -> dict[str, Any]:
        """Return the shortest free path between two objects or positions.

        Raises:
            NoPathError: there is none; the message says how wide a path is, or that both are on
                different storeys.
        """
        ends = self._place(start), self._place(goal)
        path = self._scene.path(*ends, width_m)
        rooms = self._scene.building.rooms.numbers_of(ends[0].storey)[tuple(path.cells.T)]
        passed = [int(room) + 1 for room, _ in groupby(rooms[rooms >= 0])]
        return {
            "length_m": round(path.length_m, 2),
            "free_width_m": round(path.width_m, 2),
            "narrowest_m": path.narrowest_m.round(3).tolist(),
            "way_points_m": path.points_m[:_MAX_POINTS].round(3).tolist(),
            "way_points": len(path.points_m),
            "rooms": passed[:MAX_RESULTS],
        }

    def changes(self, first: int, limit: int) -> dict[str, Any]:
        """Return the objects that were moved, are new or are gone since the earlier run."""
        values = self._changes
        changes = values["changes"][first : first + limit]
        return {"total": len(values["changes"]), **values, "changes": changes}

    def pose_towards(self, number: int) -> Array:
        """Return T_map_camera [4, 4] of the keyframe that sees an object best, turned to it."""
        scene = self._scene
        points_m = thinned(scene.objects[self._checked(number)].points_m, 200)
        seen = [scene.views.sight(k, points_m).surface.mean() for k in range(len(scene.views))]
        if not seen or max(seen) <= 0:
            raise NotAvailableError(f"no keyframe sees object {number}; give a position and target")
        eye = scene.views.T_map_camera[int(np.argmax(seen)), :3, 3]
        return looking_at(eye, scene.objects[number].box.centre_m, scene.ground.up)

    def pose_of(self, position_m: Point, target_m: Point) -> Array:
        """Return T_map_camera [4, 4] of an upright camera."""
        return looking_at(np.array(position_m), np.array(target_m), self._scene.ground.up)

    @property
    def _scene(self) -> MappedScene:
        return self._run.scene

    @cached_property
    def _objects(self) -> list[dict[str, Any]]:
        """The short description of each object."""
        scene = self._scene
        several = len(scene.building.floors.storeys) > 1
        described = [scene.describe(k) for k in range(len(scene.objects))]
        return [
            {
                "object_id": number,
                "name": shown(item["name"]),
                "colour": item["colour"],
                "rooms": item["rooms"],
                **({"storey": item["storey"]} if several else {}),
                "centre_m": item["box"]["centre_m"],
                "size_m": item["box"]["size_m"],
                "confidence": item["confidence"],
                "first_seen": item["first_seen"],
                "last_seen": item["last_seen"],
            }
            for number, item in enumerate(described)
        ]

    def _describe_object(self, number: int) -> dict[str, Any]:
        scene = self._scene
        related = [
            {"relation": r.kind, **self._named(r.target)}
            for r in scene.relations
            if r.source == number
        ] + [
            {"relation": f"{r.kind} (reversed)", **self._named(r.source)}
            for r in scene.relations
            if r.target == number
        ]
        return {
            **self._objects[number],
            "path": [shown(name) for name in scene.objects[number].node.path],
            "relations": related[:MAX_RESULTS],
            "relations_total": len(related),
        }

    def _named(self, number: int) -> dict[str, Any]:
        return {"object_id": number, "name": shown(self._scene.objects[number].node.name)}

    def _checked(self, number: int) -> int:
        count = len(self._scene.objects)
        if count == 0:
            raise NotAvailableError("the map has no objects; it may have too few labels")
        if not 0 <= number < count:
            raise NotAvailableError(
                f"there is no object {number}; the objects are 0 to {count - 1}: use find"
            )
        return number

    def _check_room(self, room: int) -> None:
        count = len(self._scene.building.rooms)
        if not 1 <= room <= count:
            raise NotAvailableError(f"there is no room {room}; the map has {count} rooms, from 1")

    def _place(self, end: int | Point) -> Place:
        scene = self._scene
        if isinstance(end, int):
            place = scene.place(self._checked(end))
            return replace(place, name=shown(place.name))
        return scene.place_at(np.array(end), "({:.2f}, {:.2f}, {:.2f})".format(*end))

    @cached_property
    def _changes(self) -> dict[str, Any]:
        earlier = self._earlier
        if earlier is None or earlier.earlier is None:
            raise NotAvailableError(
                "no earlier run to compare with; start the server with --changes.earlier RUN"
            )
        try:
            selection = select(earlier.earlier)
            require_metres(selection.run, self._scene.selection.run)
            T_before_after = np.eye(4)
            if not earlier.same_frame:
                run = self._scene.selection.run
                T_before_after = relative_pose(selection.run, run, earlier.registration)
            before = map_scene(selection, ObjectGraphOptions())
            found = changes_between(before, self._scene, T_before_after)
        except ToolkitError as error:
            raise NotAvailableError(_without(error, earlier.earlier)) from error
        # In the frame of the served map, in which everything else is.
        values = found.transformed(se3.inverse(T_before_after)).values()
        for change in values["changes"]:
            change["name"] = shown(change["name"])
        return values


def shown(text: str, max_length: int = _MAX_NAME) -> str:
    """Return text from data as it may be shown: without control characters, HTML escaped."""
    text = " ".join(_UNSAFE.sub("?", text).split())
    if len(text) > max_length:
        text = text[: max_length - 3] + "..."
    return html.escape(text, quote=False)


def looking_at(eye_m: Array, target_m: Array, up: Array) -> Array:
    """Return T_map_camera [4, 4] of a camera at a place that looks at another, held upright.

    Raises:
        SettingsError: the places are the same.
    """
    forward = target_m - eye_m
    if np.linalg.norm(forward) < _MIN_SIGHT_M:
        raise SettingsError("position_m and target_m are the same; move one of them")
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(forward):  # straight up or down
        right = np.eye(3)[np.abs(up).argmin()]
        right = right - up * (right @ up)
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    return se3.from_rotation_translation(R, eye_m)


def _counted(objects: list[dict[str, Any]]) -> dict[str, Any]:
    counts = Counter(item["name"] for item in objects)
    return {"objects": len(objects), "objects_by_name": dict(counts.most_common(MAX_RESULTS))}


def _without(error: ToolkitError, path: Path) -> str:
    """Return the message of an error without the paths of this machine."""
    return str(error).replace(f"{path}/", "").replace(str(path), "the earlier run")
