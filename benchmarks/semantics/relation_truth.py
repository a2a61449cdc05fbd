"""The true relations of the objects of synthetic rooms, from the rooms' geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.datasets.synthetic_rooms.layouts import LAYOUTS, Layout, build_parts
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.shell import DOOR_WIDTH_M
from toolkit.exports.options import ObjectGraphOptions
from toolkit.scene.graph.relations import Role
from toolkit.scene.graph.roles import ENCLOSING_NAMES
from toolkit.scene.graph.scene import WALL_NAMES
from toolkit.scene.query import CEILING_NAMES, FLOOR_NAMES

Array = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])
Pair = tuple[int, str, int]

# Furniture with a front: seats, and what shows something.
FRONT_NAMES = ("chair", "sofa", "monitor", "tv-screen", "picture", "clock")
# Width of the frame of a door at each side.
_FRAME_M = 0.05
_SPACING_M = 0.02
# An object is at most this high above, or deep in, what it stands on: bedding sinks in.
_TOUCH_M, _SUNK_M = 0.06, (0.02, 0.08, 0.15)
# What hangs at a wall is at most this far from it.
_WALL_M = 0.05
# An object is in another one whose surface is hit by this share of the rays from its top.
_ENCLOSED, _INSIDE = 0.7, 0.8
_SUPPORTED, _GAP_M, _BESIDE_M = 0.3, 0.2, 0.1
_CONE, _MAX_BOTTOM_M = np.cos(np.radians(30.0)), 0.9
_RAYS = 2000


@dataclass(frozen=True)
class TrueObject:
    """An object of a room.

    Attributes:
        number: as in the instance images.
        name: its class.
        room: index of its room.
        points_m: [N, 3] points on its surface, about 2 cm apart; z is up, the floor at z = 0.
        mesh: for rays.
        front: [2] horizontal direction of its front; None if it has none.
    """

    number: int
    name: str
    room: int
    points_m: Array
    mesh: Any
    front: Array | None

    @cached_property
    def low(self) -> Array:
        """Lowest corner [3]."""
        return self.points_m.min(axis=0)

    @cached_property
    def high(self) -> Array:
        """Highest corner [3]."""
        return self.points_m.max(axis=0)

    @cached_property
    def tree(self) -> KDTree:
        """For distances to its surface."""
        return KDTree(self.points_m)

    @property
    def role(self) -> Role:
        """How relations treat it."""
        if self.name in (*FLOOR_NAMES, *CEILING_NAMES):
            return "floor"
        if self.name in WALL_NAMES:
            return "wall"
        return "opening" if self.name in ENCLOSING_NAMES else "object"

    def hits(self, origins_m: Array, directions: Array) -> Array:
        """Distances [N] along unit directions [N, 3] to its surface, infinite for misses."""
        rays = np.concatenate([origins_m, directions], axis=1).astype(np.float32)
        answer = self.mesh.cast_rays(open3d().core.Tensor.from_numpy(rays), nthreads=1)
        return np.asarray(answer["t_hit"].numpy(), np.float64)


class TrueRelations:
    """Objects, relations, rooms and doors of a layout.

    Args:
        layout: its name.
        seed: of its furniture.
        seen: numbers of the objects that the images show; relations of others are left out.
    """

    def __init__(self, layout: str, seed: int, seen: set[int]) -> None:
        self.layout: Layout = LAYOUTS[layout]()
        parts: dict[int, list[Part]] = {}
        for part in build_parts(self.layout, seed):
            if part.object_id in seen:
                parts.setdefault(part.object_id, []).append(part)
        self.objects = {number: _object(number, own) for number, own in sorted(parts.items())}

    @cached_property
    def relations(self) -> set[Pair]:
        """The relations; those that are mutual have the lower number first."""
        ones = list(self.objects.values())
        vertical = {
            (a.number, kind, b.number)
            for a in ones
            if a.role in ("object", "opening")
            for kind, b in _support(a, [b for b in ones if b is not a])
        }
        linked = {frozenset((a, b)) for a, _, b in vertical}
        limit_m = ObjectGraphOptions().next_to_m
        near = {
            (a.number, "next to", b.number)
            for a, b in combinations(ones, 2)
            if frozenset((a.number, b.number)) not in linked and _beside(a, b, limit_m)
        }
        things = [one for one in ones if one.role == "object"]
        standing = {a for a, _, b in vertical if self.objects[b].role != "wall"}
        above = {
            (a.number, "above", b.number)
            for a in things
            for b in [_highest_below(a, things)]
            if b is not None and a.number not in standing
        }
        return vertical | near | above | self._facing(things, vertical | above)

    def _facing(self, things: Sequence[TrueObject], below: set[Pair]) -> set[Pair]:
        """The nearest object before each front, except its own group: what it stands on or hangs
        above, what stands on it, and what stands on the same object."""
        supports = {one.number: set[int]() for one in things}
        for a, _, b in below:
            if a in supports and b in supports:
                supports[a].add(b)
        found = set()
        for one in things:
            if one.front is None:
                continue
            own = supports[one.number]
            ahead = [
                (_distance_ahead(one, one.front, other), other.number)
                for other in things
                if other is not one
                and other.low[2] <= _MAX_BOTTOM_M
                and other.number not in own
                and one.number not in supports[other.number]
                and not own & supports[other.number]
            ]
            distance_m, target = min(ahead, default=(np.inf, 0))
            if distance_m <= ObjectGraphOptions().facing_m:
                found.add((one.number, "facing", target))
        return found

    @cached_property
    def structures(self) -> set[tuple[str, int]]:
        """Class and room of what encloses rooms."""
        return {(one.name, one.room) for one in self.objects.values() if one.role != "object"}

    @cached_property
    def doors(self) -> list[tuple[frozenset[int], Array, float]]:
        """Rooms, place [2] and free width in metres of the passages between rooms."""
        found: list[tuple[frozenset[int], Array, float]] = []
        for index, plan in enumerate(self.layout.rooms):
            for opening in plan.openings:
                if opening.kind != "passage":
                    continue
                place, outward = plan.door_way(opening)
                other = self.room_at(place + 0.5 * outward)
                pair = frozenset((index, other))
                if other >= 0 and all(pair != known for known, _, _ in found):
                    found.append((pair, place, DOOR_WIDTH_M - 2 * _FRAME_M))
        return found

    def room_at(self, place: Array) -> int:
        """Index of the room at a place (x, y), -1 outside of rooms."""
        for index, plan in enumerate(self.layout.rooms):
            x0, y0, x1, y1 = plan.bounds_m
            if x0 <= place[0] <= x1 and y0 <= place[1] <= y1:
                return index
        return -1


def _object(number: int, parts: list[Part]) -> TrueObject:
    vertices, triangles, count = [], [], 0
    for patch in (patch for part in parts for patch in part.patches):
        vertices.append(patch.points.reshape(-1, 3))
        triangles.append(patch.triangles() + count)
        count += len(vertices[-1])
    corners, faces = np.concatenate(vertices), np.concatenate(triangles)
    core = open3d().core
    mesh = open3d().t.geometry.RaycastingScene()
    mesh.add_triangles(
        core.Tensor.from_numpy(corners.astype(np.float32)),
        core.Tensor.from_numpy(faces.astype(np.uint32)),
    )
    front = None
    if parts[0].class_name in FRONT_NAMES:
        front = -parts[0].T_room_piece[:2, 1]
    room, name = number // 1000, parts[0].class_name
    return TrueObject(number, name, room, _sampled(corners[faces]), mesh, front)


def _sampled(triangles_m: Array) -> Array:
    """Points on triangles [T, 3, 3] on a regular grid in barycentric coordinates."""
    points = []
    for a, b, c in triangles_m:
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - a), np.linalg.norm(c - b))
        steps = max(1, int(np.ceil(longest / _SPACING_M)))
        i, j = (k.reshape(-1) for k in np.mgrid[0 : steps + 1, 0 : steps + 1])
        inside = i + j <= steps
        u, v = (i[inside] / steps)[:, None], (j[inside] / steps)[:, None]
        points.append(a + u * (b - a) + v * (c - a))
    return np.unique(np.concatenate(points).round(4), axis=0)


def _support(one: TrueObject, others: Sequence[TrueObject]) -> list[tuple[str, TrueObject]]:
    """The container of an object, else what it stands on, else the wall that it hangs at."""
    containers = [b for b in others if b.role == "object" and _within(one, b)]
    if containers:
        return [("in", min(containers, key=lambda b: float(np.prod(b.high - b.low))))]
    standing = [("on", b) for b in _below(one, others)]
    hanging = [("on", b) for b in others if b.role == "wall" and _near(one, b, _WALL_M)]
    return standing or hanging[:1]


def _within(one: TrueObject, other: TrueObject) -> bool:
    inside = ((one.points_m >= other.low) & (one.points_m <= other.high)).all(axis=1)
    if inside.mean() < _INSIDE:
        return False
    top = np.append((one.low + one.high)[:2] / 2, one.high[2] - 0.01)
    directions = np.random.default_rng(0).standard_normal((_RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(top, directions.shape)
    return float(np.isfinite(other.hits(origins, directions)).mean()) >= _ENCLOSED


def _below(one: TrueObject, others: Sequence[TrueObject]) -> list[TrueObject]:
    """What enough rays down from the lowest part of an object hit first, and at once."""
    candidates = [
        b
        for b in others
        if b.role in ("object", "floor")
        and b.low[2] <= one.low[2] <= b.high[2] + _TOUCH_M
        and (np.maximum(one.low - b.high, b.low - one.high)[:2] <= 0.0).all()
    ]
    if not candidates:
        return []
    lowest = one.points_m[one.points_m[:, 2] <= one.low[2] + 0.01]
    down = np.broadcast_to(-UP, lowest.shape)
    height_m = np.full((len(candidates), len(lowest)), -np.inf)
    for sunk_m in _SUNK_M:  # the highest origin can be inside of the other, where rays hit nothing
        hits_m = np.array([b.hits(lowest + sunk_m * UP, down) for b in candidates])
        touched = hits_m <= sunk_m + _TOUCH_M
        height_m = np.where(touched, np.maximum(height_m, sunk_m - hits_m), height_m)
    first = np.where(np.isfinite(height_m).any(axis=0), height_m.argmax(axis=0), -1)
    shares = np.bincount(first[first >= 0], minlength=len(candidates)) / len(lowest)
    return [b for b, share in zip(candidates, shares, strict=True) if share >= _SUPPORTED]


def _beside(a: TrueObject, b: TrueObject, limit_m: float) -> bool:
    roles = {a.role, b.role}
    return "floor" not in roles and "object" in roles and _near(a, b, limit_m)


def _near(a: TrueObject, b: TrueObject, limit_m: float) -> bool:
    if (np.maximum(a.low - b.high, b.low - a.high) > limit_m).any():
        return False
    close = ((a.points_m >= b.low - limit_m) & (a.points_m <= b.high + limit_m)).all(axis=1)
    distance_m, _ = b.tree.query(a.points_m[close], distance_upper_bound=limit_m)
    return bool(np.isfinite(distance_m).any())


def _highest_below(one: TrueObject, things: Sequence[TrueObject]) -> TrueObject | None:
    below = [b for b in things if b is not one and _above(one, b)]
    return max(below, key=lambda b: float(b.high[2]), default=None)


def _above(one: TrueObject, other: TrueObject) -> bool:
    apart = np.maximum(one.low - other.high, other.low - one.high)
    if one.low[2] - other.high[2] < _GAP_M or (apart[:2] > _BESIDE_M).any():
        return False
    # What hangs at a wall is above the furniture at this wall, which does not touch it.
    flat = KDTree(other.points_m[:, :2])
    distance_m, _ = flat.query(one.points_m[::4, :2], distance_upper_bound=_BESIDE_M)
    return float(np.isfinite(distance_m).mean()) >= _SUPPORTED


def _distance_ahead(one: TrueObject, front: Array, other: TrueObject) -> float:
    offset = other.points_m[:, :2] - (one.low[:2] + one.high[:2]) / 2
    distance_m = np.linalg.norm(offset, axis=1)
    return float(distance_m[offset @ front >= _CONE * distance_m].min(initial=np.inf))
