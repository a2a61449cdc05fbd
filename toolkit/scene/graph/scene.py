"""Export a labelled map as JSON values: tree with counts, objects with boxes, room."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.boxes import Ground, OrientedBox, floor_area_m2, oriented_box
from toolkit.scene.query import (
    CEILING_NAMES,
    FLOOR_NAMES,
    LabelledMap,
    SceneObject,
)
from toolkit.semantics.lexicon.matching import LIST_CLASSES, match
from toolkit.semantics.options import ObjectOptions
from toolkit.semantics.taxonomy import VOID

WALL_NAMES = ("wall",)
_DECIMALS = 4  # of lengths in metres: 0.1 mm


@dataclass(frozen=True)
class SceneReader:
    """Describes a labelled map by JSON values; lengths are in metres.

    Attributes:
        map: the labelled Gaussians.
        options: options of the extraction of objects.
        viewpoint_m: [3], point from which distances are measured.
        floor: classes and groups of the floor; names that are not in the tree are ignored.
        known_ground: the plane of the floor if it is known; by default it is fitted.
        metric: whether lengths are in metres; otherwise their unit is arbitrary.
    """

    map: LabelledMap
    options: ObjectOptions
    viewpoint_m: NDArray[np.float64]
    floor: Sequence[str] = FLOOR_NAMES
    known_ground: Ground | None = None
    metric: bool = True

    @functools.cached_property
    def ground(self) -> Ground | None:
        """The plane of the floor.

        Without one, boxes have any orientation and floor areas are null.
        """
        return self.known_ground or self.map.ground(self.floor)

    def answer(self, text: str, remedy: str = LIST_CLASSES) -> dict[str, Any]:
        """Describe what a text means: Gaussians, confidence, floor area and objects.

        For a text that is not the name or path of a node, the answer also has the text (`asked`),
        the nodes (`paths`) and the reason for them (`explanation`); `path` is what they share.

        Args:
            text: a name, path or noun that `match` understands.
            remedy: how to list the classes, for errors.

        Raises:
            FormatError: nothing in the tree matches, or several things do.
        """
        meant = match(text, self.map.taxonomy, remedy=remedy)
        members = np.zeros(len(self.map), bool)
        objects: list[SceneObject] = []
        for node in meant.nodes:
            members |= self.map.members(node, self.options.min_confidence)
            objects += self.map.objects(node, self.ground, self.options)
        objects.sort(key=lambda found: -len(found))
        paths = [list(node.path) for node in meant.nodes]
        reason = {"asked": text, "paths": paths, "explanation": meant.explanation}
        return {
            "path": _shared(paths),
            "metric": self.metric,
            **(reason if meant.explanation else {}),
            "gaussians": int(members.sum()),
            "confidence": self._confidence(members),
            "floor_area_m2": self._area([found.index for found in objects]),
            "objects": [self.describe(found) for found in objects],
        }

    def tree(self) -> dict[str, Any]:
        """Return the nested nodes that have Gaussians, with their number and mean confidence."""
        return {
            "gaussians": len(self.map),
            "unlabelled": int((self.map.labels.label == VOID).sum()),
            "tree": self._nodes(),
        }

    def summary(self) -> dict[str, Any]:
        """Describe the scene: tree, all objects, and the room."""
        taxonomy = self.map.taxonomy
        objects = self.map.objects(None, self.ground, self.options)
        return {
            "metric": self.metric,
            "taxonomy": {
                "name": taxonomy.name,
                "digest": taxonomy.digest,
                "levels": list(taxonomy.levels),
            },
            "up": None if self.ground is None else self.ground.up.round(6).tolist(),
            "viewpoint_m": self.viewpoint_m.round(_DECIMALS).tolist(),
            "room": self._room(),
            **self.tree(),
            "objects": [{"id": i, **self.describe(found)} for i, found in enumerate(objects)],
        }

    def _nodes(self) -> list[dict[str, Any]]:
        nodes, counts = self.map.taxonomy.nodes, self.map.counts()
        # Levels are decoded independently: a class can have Gaussians where its group has none.
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

    def describe(self, found: SceneObject) -> dict[str, Any]:
        """Return class, box, distance and areas of an object."""
        offsets_m = self.map.means_m[found.index] - self.viewpoint_m
        return {
            "name": found.node.name,
            "path": list(found.node.path),
            "is_class": found.node.leaf,
            "instance": found.instance or None,
            "gaussians": len(found),
            "confidence": round(found.confidence, _DECIMALS),
            "box": box_values(found.box),
            "distance_m": round(float(np.linalg.norm(offsets_m, axis=1).min()), _DECIMALS),
            "floor_area_m2": self._area([found.index]),
        }

    def _room(self) -> dict[str, Any] | None:
        """Return the box around floor, walls and ceiling, and the observed floor area."""
        shell = self._without_noise([*self.floor, *WALL_NAMES, *CEILING_NAMES])
        if len(shell) == 0:
            return None
        box = oriented_box(self.map.means_m[shell], self.ground)
        return {
            "box": box_values(box),
            "floor_area_m2": self._area([self._without_noise(self.floor)]),
        }

    def _without_noise(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Return the indices of the Gaussians of some classes, without noise."""
        members = self.map.selected(self.map.known(names), self.options.min_confidence)
        pieces = self.map.pieces(np.flatnonzero(members), self.options)
        return np.concatenate([np.empty(0, np.intp), *pieces])

    def _area(self, parts: Sequence[NDArray[np.intp]]) -> float | None:
        """Return the floor area below the union of some Gaussians, None without a floor plane."""
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


def _shared(paths: Sequence[list[str]]) -> list[str]:
    """Return the names that all paths start with."""
    steps = zip(*paths, strict=False)
    return [names[0] for names in itertools.takewhile(lambda names: len(set(names)) == 1, steps)]


def box_values(box: OrientedBox) -> dict[str, Any]:
    """Return centre, size and axes of a box as JSON values."""
    return {
        "centre_m": box.centre_m.round(_DECIMALS).tolist(),
        "size_m": box.size_m.round(_DECIMALS).tolist(),
        "axes": box.axes.round(6).tolist(),
        "upright": box.upright,
    }
