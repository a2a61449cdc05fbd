"""The objects of a scene graph as the viewer shows them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.base.errors import FormatError
from toolkit.exports.mapped_scene import MappedScene
from toolkit.io.guarded.documents import read_json
from toolkit.tools.viewer.scene import ShownObject

_SIGNS = np.array([corner[::-1] for corner in itertools.product((-0.5, 0.5), repeat=3)])


def shown_objects(scene: MappedScene) -> tuple[ShownObject, ...]:
    """Return the objects in rooms, by storey, room and their numbers in the scene graph."""
    names = {number: f"{found.node.name} {number}" for number, found in enumerate(scene.objects)}
    lines = _relation_lines(((r.source, r.target, r.kind) for r in scene.relations), names)
    rows = []
    for number, found in enumerate(scene.objects):
        if scene.enclosing[number]:
            continue
        box = found.box
        corners = _corners_m(box.centre_m, box.size_m, box.axes)
        room = next(iter(scene.rooms_of(number)), len(scene.building.rooms))
        name = f"room {room + 1}" if room < len(scene.building.rooms) else ""
        level = scene.storeys[number][0]
        storey = f"storey {level + 1}" if len(scene.building.spaces) > 1 else ""
        related = tuple(lines.get(number, ()))
        path = tuple(found.node.path)
        one = ShownObject(number, names[number], name, corners, related, storey, path)
        rows.append((level, room, one))
    return _in_order(rows)


def graph_objects(
    graph: Mapping[str, Any], voxels_m: Mapping[int, NDArray[np.float64]] | None = None
) -> tuple[ShownObject, ...]:
    """Return the objects of a graph in node-link format, ordered as by `shown_objects`.

    Args:
        graph: the graph.
        voxels_m: a point [V, 3] in each voxel of an object by its number, as far as it is known.

    Raises:
        KeyError, TypeError, ValueError: it is no scene graph.
    """
    things = [node for node in graph["nodes"] if node["kind"] in ("object", "structure")]
    several = len(graph["graph"]["storeys_m"]) > 1
    names = {int(node["id"]): f"{node['name']} {node['id']}" for node in things}
    ends = ((edge["source"], edge["target"], edge["relation"]) for edge in graph["edges"])
    lines = _relation_lines((end for end in ends if end[1] in names), names)
    rows = []
    for node in things:
        if node["kind"] == "structure":
            continue
        number, box = int(node["id"]), node["box"]
        corners = _corners_m(box["centre_m"], box["size_m"], box["axes"])
        rooms = [int(room) for room in node["rooms"]]
        room = f"room {rooms[0]}" if rooms else ""
        level = int(node["storey"])
        storey = f"storey {level}" if several else ""
        related = tuple(lines.get(number, ()))
        path = tuple(node["path"])
        own_m = (voxels_m or {}).get(number)
        one = ShownObject(number, names[number], room, corners, related, storey, path, own_m)
        rows.append((level, rooms[0] if rooms else len(graph["nodes"]) + 1, one))
    return _in_order(rows)


def read_graph_objects(file: Path) -> tuple[ShownObject, ...]:
    """Return the objects of a scene graph in JSON; none if the file is missing.

    Raises:
        FormatError: the file is damaged.
    """
    try:
        return graph_objects(read_json(file))
    except FileNotFoundError:
        return ()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(
            f"{file} is damaged ({error!r}); remove it to view the map without its objects"
        ) from error


def _relation_lines(
    relations: Iterable[tuple[int, int, str]], names: Mapping[int, str]
) -> dict[int, list[str]]:
    """Lines about the relations (source, target, kind) of each object."""
    lines: dict[int, list[str]] = {}
    for source, target, kind in relations:
        lines.setdefault(source, []).append(f"{kind} {names[target]}")
        if kind == "next to":
            lines.setdefault(target, []).append(f"next to {names[source]}")
    return lines


def _corners_m(centre_m: ArrayLike, size_m: ArrayLike, axes: ArrayLike) -> NDArray[np.float64]:
    corners = np.asarray(centre_m) + (_SIGNS * np.asarray(size_m)) @ np.asarray(axes).T
    return np.asarray(corners, np.float64)


def _in_order(rows: list[tuple[int, int, ShownObject]]) -> tuple[ShownObject, ...]:
    """Objects with the numbers of their storey and room, by all three numbers."""
    return tuple(one for *_, one in sorted(rows, key=lambda row: (*row[:2], row[2].number)))
