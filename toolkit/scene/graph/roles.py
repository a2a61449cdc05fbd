"""Roles of classes in the geometry of rooms: floors, walls, openings and objects."""

from __future__ import annotations

from collections.abc import Sequence

from toolkit.base.errors import FormatError
from toolkit.scene.graph.relations import Role
from toolkit.scene.graph.scene import WALL_NAMES
from toolkit.scene.graph.storeys import StoreyKind
from toolkit.scene.query import CEILING_NAMES, FLOOR_NAMES
from toolkit.semantics.taxonomy import Taxonomy

# Classes that enclose rooms. A door that is open leaves its frame, a closed one separates.
ENCLOSING_NAMES = (*WALL_NAMES, "window", "door", "blinds", "curtain", "pillar", "column")


class Roles:
    """The role of each class and group of a tree.

    Args:
        taxonomy: the tree.
        floor: classes and groups of the floor; names that are not in the tree are ignored.
    """

    def __init__(self, taxonomy: Taxonomy, floor: Sequence[str] = FLOOR_NAMES) -> None:
        self._floors = _paths(taxonomy, floor)
        self._ceilings = _paths(taxonomy, CEILING_NAMES)
        self._walls = _paths(taxonomy, WALL_NAMES)
        self._enclosing = _paths(taxonomy, ENCLOSING_NAMES)

    def of(self, path: tuple[str, ...]) -> Role:
        """Return the role of a node by its path; ceilings count as floors."""
        if _below(path, [*self._floors, *self._ceilings]):
            return "floor"
        if _below(path, self._walls):
            return "wall"
        return "opening" if _below(path, self._enclosing) else "object"

    def kind(self, path: tuple[str, ...]) -> StoreyKind:
        """Return what a node is in a storey; ceilings count as structures."""
        role = self.of(path)
        if role == "object":
            return "object"
        return "floor" if role == "floor" and not self.is_ceiling(path) else "structure"

    def is_ceiling(self, path: tuple[str, ...]) -> bool:
        """Return whether a node is the ceiling or a part of it."""
        return _below(path, self._ceilings)


def _paths(taxonomy: Taxonomy, names: Sequence[str]) -> list[tuple[str, ...]]:
    found = []
    for name in names:
        try:
            found.append(taxonomy.find(name).path)
        except FormatError:
            continue  # not in the tree, or ambiguous
    return found


def _below(path: tuple[str, ...], others: Sequence[tuple[str, ...]]) -> bool:
    return any(path[: len(other)] == other for other in others)
