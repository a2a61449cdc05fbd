"""Spatial relations between objects of a labelled map: on, in, next to, above, facing.

The relations are geometric: they are derived from the Gaussians of the objects above the plane of
the floor, and need no knowledge about classes.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.neighbors import KDTree

from toolkit.semantics.boxes import Ground
from toolkit.semantics.facing import front_of

Array = NDArray[np.float64]
RelationKind = Literal["on", "in", "next to", "above", "facing"]
# Openings are doors and windows.
Role = Literal["object", "opening", "wall", "floor"]

# Cell of the comparison of footprints; larger than the spacing of Gaussians.
_CELL_M = 0.05
# Minimum share of the footprint of an object below which a supporting object lies.
_MIN_SUPPORT = 0.3
# The lowest part of an object is this percentile of the heights of its Gaussians, because single
# Gaussians with wrong labels may lie below.
_BOTTOM_PERCENT = 2.0
# Minimum share of the Gaussians of an object inside the box of its container.
_MIN_INSIDE = 0.8
# A container surrounds an object in at least this many of 16 horizontal directions.
_SECTORS, _MIN_SECTORS = 16, 12
# Objects with a smaller gap to the one below stand on something that no camera has seen.
_MIN_GAP_M = 0.2
# An object faces the nearest one within this angle of its front, seen from its centre.
_MIN_FACING = np.cos(np.radians(30.0))
# Objects whose lowest part is higher above the floor hang at a wall and are not faced.
_MAX_BOTTOM_M = 0.9


@dataclass(frozen=True)
class Relation:
    """A relation between two objects, by their numbers: `source` is on (in, ...) `target`."""

    source: int
    target: int
    kind: RelationKind


@dataclass(frozen=True)
class RelationOptions:
    """Options of relations.

    Attributes:
        contact_m: maximum vertical gap to a supporting object, in metres.
        next_to_m: maximum distance between objects that are next to each other, in metres.
        facing_m: maximum distance to the object that another one faces, in metres.
    """

    contact_m: float = 0.08
    next_to_m: float = 0.3
    facing_m: float = 2.5


class _Body:
    """The points [N, 3] of an object along the axes of the floor; the third is the height."""

    def __init__(self, points: Array) -> None:
        self.points = points
        self.bottom = float(np.percentile(points[:, 2], _BOTTOM_PERCENT))
        self.low, self.high = points.min(axis=0), points.max(axis=0)
        self.cells = _cells(points)

    def on(self, other: _Body, contact_m: float) -> bool:
        """Return whether enough of the footprint has points of `other` right below the bottom."""
        if self._apart(other):
            return False
        height = other.points[:, 2]
        touching = (height >= self.bottom - contact_m) & (height <= self.bottom + contact_m / 2)
        # What the object hides was not observed, so its surroundings support it as well.
        support = _grown(_cells(other.points[touching]))
        return len(self.cells & support) >= _MIN_SUPPORT * len(self.cells)

    def within(self, other: _Body) -> bool:
        """Return whether `other` surrounds this object."""
        inside = ((self.points >= other.low) & (self.points <= other.high)).all(axis=1)
        if inside.mean() < _MIN_INSIDE:
            return False
        heights = other.points[:, 2]
        beside = other.points[(heights >= self.bottom) & (heights <= self.high[2])]
        offset = beside[:, :2] - self.points[:, :2].mean(axis=0)
        angles = np.arctan2(offset[:, 1], offset[:, 0])
        sectors = np.floor((angles + np.pi) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
        return len(np.unique(sectors)) >= _MIN_SECTORS

    def above(self, other: _Body) -> bool:
        """Return whether enough of the footprint lies over the other, with a gap between them."""
        if self.bottom - other.high[2] < _MIN_GAP_M:
            return False
        return len(self.cells & other.cells) >= _MIN_SUPPORT * len(self.cells)

    def _apart(self, other: _Body) -> bool:
        """Return whether the footprints are more than two cells apart."""
        gap = np.maximum(self.low - other.high, other.low - self.high)
        return bool((gap[:2] > 2 * _CELL_M).any())

    def near(self, other: _Body, distance_m: float) -> Array:
        """Return the points [N, 3] that may be within a distance of the other."""
        low, high = other.low - distance_m, other.high + distance_m
        return self.points[((self.points >= low) & (self.points <= high)).all(axis=1)]

    def far(self, other: _Body, distance_m: float) -> bool:
        """Return whether the boxes are farther from each other than a distance."""
        gap = np.maximum(self.low - other.high, other.low - self.high)
        return bool((gap > distance_m).any())


def relations(
    objects: Sequence[Array],
    ground: Ground,
    roles: Sequence[Role],
    options: RelationOptions | None = None,
    cameras_m: Array | None = None,
) -> list[Relation]:
    """Return the relations between objects.

    An object is in another one that surrounds it, else on the one with points right below its
    bottom. Objects are next to each other if neither supports or contains the other and they are
    close; such pairs are reported once. Walls and floors are neither on nor in anything. Objects
    can be next to walls, but not to floors. An object is above the highest one below it that does
    not support it, and seats and panels face the nearest object before them.

    Args:
        objects: centres [n, 3] of the Gaussians of each object, in the frame of the map.
        ground: plane of the floor.
        roles: role of each object; ceilings count as floors.
        options: options of the relations.
        cameras_m: [P, 3] positions of the camera, which panels face; without them, panels have no
            front.
    """
    options = options or RelationOptions()
    bodies = [_Body(points_m @ ground.axes) for points_m in objects]
    vertical = [
        relation
        for source, body in enumerate(bodies)
        if roles[source] in ("object", "opening")
        for relation in _support(source, body, bodies, roles, options)
    ]
    linked = {frozenset((r.source, r.target)) for r in vertical}
    trees = [KDTree(body.points) for body in bodies]

    def near(a: int, b: int) -> bool:
        pair = {roles[a], roles[b]}
        if frozenset((a, b)) in linked or "floor" in pair or "object" not in pair:
            return False
        if bodies[a].far(bodies[b], options.next_to_m):
            return False
        points = bodies[a].near(bodies[b], options.next_to_m)
        if len(points) == 0:
            return False
        distance_m, _ = trees[b].query(points)
        return bool(distance_m.min() <= options.next_to_m)

    pairs = itertools.combinations(range(len(bodies)), 2)
    things = [k for k, role in enumerate(roles) if role == "object"]
    cameras = np.empty((0, 3)) if cameras_m is None else cameras_m @ ground.axes
    floor = np.array([0.0, 0.0, ground.height_m])
    return [
        *vertical,
        *(Relation(a, b, "next to") for a, b in pairs if near(a, b)),
        *_above(things, bodies, linked),
        *_facing(things, bodies, floor, cameras - floor, options.facing_m),
    ]


def _above(
    things: Sequence[int], bodies: Sequence[_Body], linked: set[frozenset[int]]
) -> list[Relation]:
    """Return what each object hangs above; nothing for an object that stands on another one."""
    found = []
    for source in things:
        if any(source in pair and _higher(source, pair, bodies) for pair in linked):
            continue
        below = [k for k in things if k != source and bodies[source].above(bodies[k])]
        if below:
            highest = max(below, key=lambda k: float(bodies[k].high[2]))
            found.append(Relation(source, highest, "above"))
    return found


def _higher(source: int, pair: frozenset[int], bodies: Sequence[_Body]) -> bool:
    (other,) = pair - {source}
    return bodies[source].bottom > bodies[other].bottom


def _facing(
    things: Sequence[int], bodies: Sequence[_Body], floor: Array, cameras: Array, facing_m: float
) -> list[Relation]:
    """Return the nearest object before each object that has a front; nothing that hangs.

    Args:
        floor: [3] a point of the floor; the third axis is up.
        cameras: [P, 3] positions of the camera relative to it.
    """
    found = []
    targets = [k for k in things if bodies[k].bottom - floor[2] <= _MAX_BOTTOM_M]
    for source in things:
        body = bodies[source]
        front = front_of(body.points - floor, cameras)
        if front is None:
            continue
        start = (body.low[:2] + body.high[:2]) / 2
        ahead = [(_distance_ahead(start, front, bodies[k]), k) for k in targets if k != source]
        distance, target = min(ahead, default=(np.inf, -1))
        if distance <= facing_m:
            found.append(Relation(source, target, "facing"))
    return found


def _distance_ahead(start: Array, front: Array, body: _Body) -> float:
    """Return the distance to the points of a body within an angle of a direction."""
    offset = body.points[:, :2] - start
    distance = np.linalg.norm(offset, axis=1)
    ahead = offset @ front >= _MIN_FACING * np.maximum(distance, 1e-9)
    return float(distance[ahead].min(initial=np.inf))


def _support(
    source: int,
    body: _Body,
    bodies: Sequence[_Body],
    roles: Sequence[Role],
    options: RelationOptions,
) -> list[Relation]:
    """Return the container of an object, else what it stands on."""
    others = [k for k in range(len(bodies)) if k != source]
    containers = [k for k in others if roles[k] == "object" and body.within(bodies[k])]
    if containers:
        # The smallest container; the others contain that one.
        smallest = min(containers, key=lambda k: float(np.prod(np.ptp(bodies[k].points, axis=0))))
        return [Relation(source, smallest, "in")]
    # An object that reaches below another one does not stand on it.
    return [
        Relation(source, k, "on")
        for k in others
        if body.on(bodies[k], options.contact_m) and not bodies[k].on(body, options.contact_m)
    ]


def _cells(points: Array) -> set[tuple[int, int]]:
    cells = np.unique(np.floor(points[:, :2] / _CELL_M).astype(int), axis=0)
    return set(map(tuple, cells.tolist()))


def _grown(cells: set[tuple[int, int]]) -> set[tuple[int, int]]:
    steps = (-1, 0, 1)
    return {(x + i, y + j) for x, y in cells for i in steps for j in steps}
