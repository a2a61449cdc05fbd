"""A labelled map as plain values: the tree with counts, objects with boxes, the room."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.boxes import Ground, OrientedBox, floor_area_m2, oriented_box
from toolkit.semantics.query import (
    CEILING_NAMES,
    FLOOR_NAMES,
    LabelledMap,
    ObjectOptions,
    SceneObject,
)
from toolkit.semantics.taxonomy import VOID

_WALL_NAMES = ("wall",)
# Fractions of a millimetre are no news.
_DECIMALS = 4


@dataclass(frozen=True)
class SceneReader:
    """Puts what a labelled map tells into JSON values; lengths in metres.

    Attributes:
        map: the labelled Gaussians.
        options: what counts as one object.
        viewpoint_m: [3], where distances are measured from.
        floor: classes and groups of the floor; those that the tree lacks do not matter.
    """

    map: LabelledMap
    options: ObjectOptions
    viewpoint_m: NDArray[np.float64]
    floor: Sequence[str] = FLOOR_NAMES

    @functools.cached_property
    def ground(self) -> Ground | None:
        """What boxes stand on; without it they are free, and areas of floor are null."""
        return self.map.ground(self.floor)

    def answer(self, name: str) -> dict[str, Any]:
        """What the map knows about a class or group.

        Raises:
            FormatError: the name is none of the tree, or that of several nodes.
        """
        node = self.map.taxonomy.find(name)
        members = self.map.members(node, self.options.min_confidence)
        objects = self.map.objects(node, self.ground, self.options)
        return {
            "path": list(node.path),
            "gaussians": int(members.sum()),
            "confidence": self._confidence(members),
            "floor_area_m2": self._area([found.index for found in objects]),
            "objects": [self._object(found) for found in objects],
        }

    def tree(self) -> dict[str, Any]:
        """The nodes that have Gaussians, nested, with their number and mean confidence."""
        return {
            "gaussians": len(self.map),
            "unlabelled": int((self.map.labels.label == VOID).sum()),
            "tree": self._nodes(),
        }

    def summary(self) -> dict[str, Any]:
        """The whole scene: tree, all objects, and the room around them."""
        taxonomy = self.map.taxonomy
        objects = self.map.objects(None, self.ground, self.options)
        return {
            "taxonomy": {
                "name": taxonomy.name,
                "digest": taxonomy.digest,
                "levels": list(taxonomy.levels),
            },
            "up": None if self.ground is None else self.ground.up.round(6).tolist(),
            "viewpoint_m": self.viewpoint_m.round(_DECIMALS).tolist(),
            "room": self._room(),
            **self.tree(),
            "objects": [{"id": i, **self._object(found)} for i, found in enumerate(objects)],
        }

    def _nodes(self) -> list[dict[str, Any]]:
        nodes, counts = self.map.taxonomy.nodes, self.map.counts()
        # Levels may be decoded one by one: a class may be there where its group is not.
        filled = {
            node.path[:end]
            for node, count in zip(nodes, counts, strict=True)
            if count > 0
            for end in range(1, len(node.path) + 1)
        }
        below: dict[tuple[str, ...], list[dict[str, Any]]] = {(): []}
        for node, count in zip(nodes, counts, strict=True):
            if node.path not in filled:
                continue
            below[node.path] = []
            values = {
                "name": node.name,
                "level": self.map.taxonomy.levels[node.level],
                "gaussians": int(count),
                "confidence": self._confidence(self.map.members(node)),
                "children": below[node.path],
            }
            below[node.path[:-1]].append(values)
        return below[()]

    def _object(self, found: SceneObject) -> dict[str, Any]:
        offsets_m = self.map.means_m[found.index] - self.viewpoint_m
        return {
            "name": found.node.name,
            "path": list(found.node.path),
            "is_class": found.node.leaf,
            "gaussians": len(found),
            "confidence": round(found.confidence, _DECIMALS),
            "box": _box_values(found.box),
            "distance_m": round(float(np.linalg.norm(offsets_m, axis=1).min()), _DECIMALS),
            "floor_area_m2": self._area([found.index]),
        }

    def _room(self) -> dict[str, Any] | None:
        """The box around floor, walls and ceiling, and the floor that was seen."""
        shell = self._whole([*self.floor, *_WALL_NAMES, *CEILING_NAMES])
        if len(shell) == 0:
            return None
        box = oriented_box(self.map.means_m[shell], self.ground)
        return {
            "box": _box_values(box),
            "floor_area_m2": self._area([self._whole(self.floor)]),
        }

    def _whole(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Which Gaussians are of some classes, without what is noise."""
        members = self.map.selected(self.map.known(names), self.options.min_confidence)
        pieces = self.map.pieces(np.flatnonzero(members), self.options)
        return np.concatenate([np.empty(0, np.intp), *pieces])

    def _area(self, parts: Sequence[NDArray[np.intp]]) -> float | None:
        """Floor under some Gaussians together, None where what is down is unknown."""
        if self.ground is None:
            return None
        index = np.concatenate([np.empty(0, np.intp), *parts])
        if len(index) == 0:
            return 0.0
        return round(floor_area_m2(self.map.means_m[index], self.ground), _DECIMALS)

    def _confidence(self, members: NDArray[np.bool_]) -> float | None:
        if not members.any():
            return None
        return round(float(self.map.labels.confidence[members].mean()), _DECIMALS)


def _box_values(box: OrientedBox) -> dict[str, Any]:
    return {
        "centre_m": box.centre_m.round(_DECIMALS).tolist(),
        "size_m": box.size_m.round(_DECIMALS).tolist(),
        "axes": box.axes.round(6).tolist(),
        "upright": box.upright,
    }
