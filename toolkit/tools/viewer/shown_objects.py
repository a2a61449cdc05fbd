"""The objects of a scene graph as the viewer shows them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.base.errors import FormatError
from toolkit.io.guarded.documents import read_json
from toolkit.tools.viewer.scene import ShownObject

_SIGNS = np.array([corner[::-1] for corner in itertools.product((-0.5, 0.5), repeat=3)])


def graph_objects(
    graph: Mapping[str, Any], voxels_m: Mapping[int, NDArray[np.float32]] | None = None
) -> tuple[ShownObject, ...]:
    """Return the objects of a graph in node-link format, by storey, room and number.

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
    return tuple(one for *_, one in sorted(rows, key=lambda row: (*row[:2], row[2].number)))


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
