"""Compare the objects of two finished runs of one place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.exports.mapped_scene import MappedScene
from toolkit.geometry import se3
from toolkit.runs.visibility import KeyframeViews
from toolkit.semantics.changes import ComparedObject, MapChanges, Seen, compare_objects

# A piece of an object, such as the leg of a chair: the object has so many times its Gaussians, and
# its box, enlarged by so much, contains the centre of the piece.
_LARGER, _BESIDE_M = 4, 0.1


def changes_between(
    before: MappedScene, after: MappedScene, T_before_after: NDArray[np.float64]
) -> MapChanges:
    """Compare the objects of two maps; what encloses rooms is not compared.

    Args:
        before: the first map; changes are in its frame.
        after: the second map.
        T_before_after: [4, 4] pose of the second map in the frame of the first.
    """
    T_after_before = se3.inverse(T_before_after)
    return compare_objects(
        _objects(before, np.eye(4)),
        _objects(after, T_before_after),
        lambda points_m: _seen(before.views, points_m),
        lambda points_m: _seen(after.views, se3.transform_points(T_after_before, points_m)),
    )


def _objects(scene: MappedScene, T: NDArray[np.float64]) -> list[ComparedObject]:
    """Return the objects that are in rooms, moved by a rigid motion [4, 4]."""
    found = [
        ComparedObject(
            number, found.node.path, scene.points_m(number), found.box.centre_m, found.box.size_m
        )
        for number, found in enumerate(scene.objects)
        if not scene.enclosing[number]
    ]
    return [item.moved(T) for item in found if not any(_piece_of(item, o) for o in found)]


def _piece_of(item: ComparedObject, other: ComparedObject) -> bool:
    """Whether an object is a small part of another one of its class that it hardly touches."""
    if item.path != other.path or len(other.points_m) < _LARGER * len(item.points_m):
        return False
    low, high = other.points_m.min(axis=0), other.points_m.max(axis=0)
    inside = (item.centre_m >= low - _BESIDE_M) & (item.centre_m <= high + _BESIDE_M)
    return bool(inside.all())


def _seen(views: KeyframeViews, points_m: NDArray[np.float64]) -> Seen:
    surface = np.zeros(len(points_m), int)
    through = np.zeros(len(points_m), int)
    for view in range(len(views)):
        sight = views.sight(view, points_m)
        surface += sight.surface
        through += sight.through
    observed = surface + through > 0
    return Seen(float(observed.mean()), float((through > surface).mean()))
