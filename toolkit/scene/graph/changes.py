"""Changes between two maps of one place: objects that were moved, are new or are gone.

An object is present where the other map has points of its class. Otherwise, the views of the other
run decide: if they look through its place, it is gone (or new); if they never look there, nothing
is known. Objects that disappeared at one place and appeared at another are paired by class and
size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from toolkit.base.geometry.thinning import thinned
from toolkit.scene.query import SceneObject

Array = NDArray[np.float64]
ChangeKind = Literal["moved", "new", "gone"]

# A point is present if the other map has one of its class within this distance.
_SAME_M = 0.08
# Share of points at which an object is present, at which its place counts as looked through, and at
# which it counts as observed at all. A moved object may overlap with its old place.
_PRESENT, _THROUGH, _OBSERVED, _OVERLAPPING = 0.6, 0.5, 0.3, 0.12
# Two objects have the same size if their sides differ by less than this share, or by 0.1 m.
_SIZE_SHARE, _SIZE_M = 0.3, 0.1
_FORBIDDEN = 1e6
_SAMPLES = 400


@dataclass(frozen=True)
class Seen:
    """How the views of a run see the place of an object.

    Attributes:
        observed: share of its points that some view sees or looks through.
        through: share of its points that more views look through than see.
    """

    observed: float
    through: float


@dataclass(frozen=True)
class Change:
    """One changed object.

    Attributes:
        kind: what happened.
        before: the object in the first map, None for a new one.
        after: the object in the second map, None for one that is gone.
    """

    kind: ChangeKind
    before: SceneObject | None
    after: SceneObject | None

    @property
    def name(self) -> str:
        """Class of the object."""
        known = self.before or self.after
        assert known is not None
        return known.node.name

    def __str__(self) -> str:
        text = f"{self.kind:5}  {self.name}"
        for preposition, found in (("from", self.before), ("to", self.after)):
            if found is not None:
                x, y, z = found.box.centre_m
                word = preposition if self.kind == "moved" else "at"
                text += f"  {word} ({x:.2f}, {y:.2f}, {z:.2f})"
        return text

    def values(self) -> dict[str, Any]:
        """Return the change as JSON values."""
        values: dict[str, Any] = {"change": self.kind, "name": self.name}
        for key, found in (("before", self.before), ("after", self.after)):
            values[key] = None
            if found is not None:
                values[key] = {
                    "object": found.number,
                    "centre_m": found.box.centre_m.round(3).tolist(),
                    "size_m": found.box.size_m.round(3).tolist(),
                }
        if self.before is not None and self.after is not None:
            offset_m = float(np.linalg.norm(self.after.box.centre_m - self.before.box.centre_m))
            values["distance_m"] = round(offset_m, 3)
        return values


@dataclass(frozen=True)
class MapChanges:
    """The comparison of two maps.

    Attributes:
        changes: moved, new and gone objects.
        unchanged: number of objects of the first map that are where they were.
        unknown: objects of either map whose place the other run did not observe.
    """

    changes: list[Change]
    unchanged: int
    unknown: list[SceneObject]

    def transformed(self, T: Array) -> MapChanges:
        """Return the changes in another frame, moved by a rigid motion [4, 4]."""
        moved = [
            Change(c.kind, c.before and c.before.moved(T), c.after and c.after.moved(T))
            for c in self.changes
        ]
        return MapChanges(moved, self.unchanged, [found.moved(T) for found in self.unknown])

    def values(self) -> dict[str, Any]:
        """Return the comparison as JSON values."""
        return {
            "changes": [change.values() for change in self.changes],
            "unchanged": self.unchanged,
            "seen_by_one_run_only": len(self.unknown),
        }


SeenBy = Callable[[Array], Seen]


def compare_objects(
    before: Sequence[SceneObject],
    after: Sequence[SceneObject],
    seen_before: SeenBy,
    seen_after: SeenBy,
    min_move_m: float = 0.15,
) -> MapChanges:
    """Compare the objects of two maps in one frame.

    Args:
        before: objects of the first map.
        after: objects of the second map.
        seen_before: how the first run sees points [N, 3].
        seen_after: how the second run sees points [N, 3].
        min_move_m: objects whose centres moved by less are unchanged.
    """
    lost = _absent(before, after, seen_after, min_move_m)
    found = _absent(after, before, seen_before, min_move_m)
    pairs = _paired(lost, found)
    changes = [Change("moved", lost[a].compared, found[b].compared) for a, b in pairs]
    moved = {a for a, _ in pairs}, {b for _, b in pairs}
    unknown, absent = [], 0
    for item in [x for k, x in enumerate(lost) if k not in moved[0]]:
        absent += item.gone
        if item.gone:
            changes.append(Change("gone", item.compared, None))
        elif item.unknown:
            unknown.append(item.compared)
    unchanged = len(before) - len(pairs) - absent - len(unknown)
    for item in [x for k, x in enumerate(found) if k not in moved[1]]:
        if item.gone:
            changes.append(Change("new", None, item.compared))
        elif item.unknown:
            unknown.append(item.compared)
    return MapChanges(changes, unchanged, unknown)


@dataclass(frozen=True)
class _Absent:
    """An object that the other map does not have at its place."""

    compared: SceneObject
    seen: Seen

    @property
    def gone(self) -> bool:
        return self.seen.through >= _THROUGH

    @property
    def unknown(self) -> bool:
        return self.seen.observed < _OBSERVED


def _absent(
    objects: Sequence[SceneObject],
    others: Sequence[SceneObject],
    seen: SeenBy,
    min_move_m: float,
) -> list[_Absent]:
    """Return the objects that are not in the other map, or only overlap with what moved there."""
    trees = {}
    for path in {o.node.path for o in objects}:
        same = [o.points_m for o in others if o.node.path == path]
        trees[path] = KDTree(np.concatenate(same)) if same else None
    absent = []
    for item in objects:
        points_m = thinned(item.points_m, _SAMPLES)
        tree = trees[item.node.path]
        present = 0.0
        if tree is not None:
            present = float((tree.query(points_m)[0] <= _SAME_M).mean())
        sight = seen(points_m)
        shifted = sight.through >= _OVERLAPPING and any(
            _same_kind(item, o) and _offset_m(item, o) >= min_move_m
            for o in others
            if _overlap(item, o)
        )
        if present < _PRESENT or shifted:
            absent.append(_Absent(item, sight))
    return absent


def _paired(lost: Sequence[_Absent], found: Sequence[_Absent]) -> list[tuple[int, int]]:
    """Pair objects of the same class and size that left one place and appeared at another."""
    cost = np.full((len(lost), len(found)), _FORBIDDEN)
    for a, before in enumerate(lost):
        for b, after in enumerate(found):
            left = min(before.seen.through, after.seen.through) >= _OVERLAPPING
            if left and _same_kind(before.compared, after.compared):
                cost[a, b] = _offset_m(before.compared, after.compared)
    rows, columns = linear_sum_assignment(cost)
    return [(int(a), int(b)) for a, b in zip(rows, columns, strict=True) if cost[a, b] < _FORBIDDEN]


def _same_kind(a: SceneObject, b: SceneObject) -> bool:
    if a.node.path != b.node.path:
        return False
    one, other = np.sort(a.box.size_m), np.sort(b.box.size_m)
    allowed = np.maximum(_SIZE_SHARE * np.maximum(one, other), _SIZE_M)
    return bool((np.abs(one - other) <= allowed).all())


def _offset_m(a: SceneObject, b: SceneObject) -> float:
    return float(np.linalg.norm(a.box.centre_m - b.box.centre_m))


def _overlap(a: SceneObject, b: SceneObject) -> bool:
    """Return whether the boxes of two objects along the axes of the map overlap."""
    low = np.maximum(a.points_m.min(axis=0), b.points_m.min(axis=0))
    high = np.minimum(a.points_m.max(axis=0), b.points_m.max(axis=0))
    return bool((low < high).all())
