"""The objects of a scene graph as the page shows them."""

from __future__ import annotations

import itertools

import numpy as np

from toolkit.exports.mapped_scene import MappedScene
from toolkit.viewer.scene import ShownObject


def shown_objects(scene: MappedScene) -> tuple[ShownObject, ...]:
    """Return the objects in rooms, by storey, room and their numbers in the scene graph."""
    names = [f"{found.node.name} {number}" for number, found in enumerate(scene.objects)]
    lines: dict[int, list[str]] = {}
    for relation in scene.relations:
        text = f"{relation.kind} {names[relation.target]}"
        lines.setdefault(relation.source, []).append(text)
        if relation.kind == "next to":
            lines.setdefault(relation.target, []).append(f"next to {names[relation.source]}")
    signs = np.array([corner[::-1] for corner in itertools.product((-0.5, 0.5), repeat=3)])
    rows = []
    for number, found in enumerate(scene.objects):
        if scene.enclosing[number]:
            continue
        box = found.box
        corners = box.centre_m + (signs * box.size_m) @ box.axes.T
        room = next(iter(scene.rooms_of(number)), len(scene.building.rooms))
        name = f"room {room + 1}" if room < len(scene.building.rooms) else ""
        level = scene.storeys[number][0]
        storey = f"storey {level + 1}" if len(scene.building.spaces) > 1 else ""
        related = tuple(lines.get(number, ()))
        one = ShownObject(names[number], name, corners, related, storey)
        rows.append((level, room, number, one))
    return tuple(one for *_, one in sorted(rows, key=lambda row: row[:3]))
