"""Rules of spatial relations between objects: on, in, next to, above, facing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.bodies import Body

Array = NDArray[np.float64]
RelationKind = Literal["on", "in", "next to", "above", "facing"]
# Openings are doors and windows.
Role = Literal["object", "opening", "wall", "floor"]

# An object faces the nearest one within this angle of its front, seen from its centre.
_MIN_FACING = np.cos(np.radians(30.0))
# Objects whose lowest part is higher above the floor hang at a wall and are not faced.
MAX_FACED_M = 0.9
# What supports or contains an object is at most this many times `contact_m` away.
REACH_CONTACTS = 2
# The wall around a panel within this distance is behind it.
_BEHIND_M = 0.25


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


def may_be_near(one: Role, other: Role) -> bool:
    """Return whether objects of two roles can be next to each other."""
    return "floor" not in (one, other) and "object" in (one, other)


def support(
    source: int,
    others: Iterable[int],
    bodies: Sequence[Body] | Mapping[int, Body],
    roles: Sequence[Role] | Mapping[int, Role],
    options: RelationOptions,
) -> list[Relation]:
    """Return the container of an object, else what it stands on, else the wall that it hangs at.

    Args:
        source: number of the object.
        others: numbers of what may support it; the object itself is ignored.
        bodies: objects by number.
        roles: of the objects, by number.
        options: options of the relations.
    """
    body = bodies[source]
    reach_m = REACH_CONTACTS * options.contact_m
    near = [k for k in others if k != source and not body.far(bodies[k], reach_m)]
    containers = [k for k in near if roles[k] == "object" and body.within(bodies[k])]
    if containers:
        # The smallest container; the others contain that one.
        smallest = min(containers, key=lambda k: float(np.prod(bodies[k].high - bodies[k].low)))
        return [Relation(source, smallest, "in")]
    below = [k for k in near if roles[k] == "object" and body.on(bodies[k], options.contact_m)]
    floors = [] if below else [k for k in near if roles[k] == "floor"]
    # A cup on a book does not stand on the table, which is hardly lower.
    below = [k for k in below if not any(bodies[n].on(bodies[k], options.contact_m) for n in below)]
    below = below or _floor_below(body, floors, bodies, options.contact_m)
    if not below:
        below = [k for k in near if roles[k] == "wall" and body.hangs_at(bodies[k])][:1]
    return [Relation(source, k, "on") for k in below]


def _floor_below(
    body: Body,
    floors: Sequence[int],
    bodies: Sequence[Body] | Mapping[int, Body],
    contact_m: float,
) -> list[int]:
    """Return the floor or rug below an object, else the largest one around it; none if all are
    lower."""
    best = max(floors, key=lambda k: body.support(bodies[k], contact_m), default=None)
    if best is not None and body.on(bodies[best], contact_m):
        return [best]
    around = [k for k in floors if body.reaches(bodies[k], contact_m)]
    return [max(around, key=lambda k: len(bodies[k].cells))] if around else []


def highest_below(
    source: int, things: Iterable[int], bodies: Sequence[Body] | Mapping[int, Body]
) -> int | None:
    """Return what an object that stands on nothing is above."""
    below = [k for k in things if k != source and bodies[source].above(bodies[k])]
    return max(below, key=lambda k: bodies[k].top, default=None)


def wall_behind(
    body: Body,
    own: Iterable[Relation],
    bodies: Sequence[Body] | Mapping[int, Body],
    roles: Sequence[Role] | Mapping[int, Role],
) -> Array:
    """Return the points [n, 3] around a body of the wall that it hangs at; none without one.

    Args:
        own: what `support` returns for it.
    """
    walls = [relation.target for relation in own if roles[relation.target] == "wall"]
    parts = [bodies[wall].points_beside(body, _BEHIND_M) for wall in walls]
    return np.concatenate([np.empty((0, 3)), *parts])


class Groups:
    """What stands on, lies in or hangs above one object belongs together.

    Args:
        vertical: relations of the kinds on, in and above.
        roles: of the objects, by number; floors and walls do not form groups.
    """

    def __init__(
        self, vertical: Iterable[Relation], roles: Sequence[Role] | Mapping[int, Role]
    ) -> None:
        self._below: dict[int, set[int]] = {}
        for relation in vertical:
            if roles[relation.target] == "object":
                self._below.setdefault(relation.source, set()).add(relation.target)

    def same(self, a: int, b: int) -> bool:
        """Return whether one object supports the other, or a third one both."""
        below_a, below_b = (self._below.get(k, set()) for k in (a, b))
        return b in below_a or a in below_b or bool(below_a & below_b)


def nearest_ahead(
    body: Body,
    front: Array,
    others: Iterable[int],
    bodies: Sequence[Body] | Mapping[int, Body],
    facing_m: float,
) -> int | None:
    """Return the nearest of some objects before the front of a body.

    Args:
        front: [2] horizontal direction.
        others: numbers of the objects.
        facing_m: maximum distance.
    """
    start = (body.low[:2] + body.high[:2]) / 2
    ahead = [(_distance_ahead(start, front, bodies[k]), k) for k in others]
    distance_m, target = min(ahead, default=(np.inf, -1))
    return target if distance_m <= facing_m else None


def _distance_ahead(start: Array, front: Array, body: Body) -> float:
    """Return the distance to the points of a body within an angle of a direction."""
    offset = body.points[:, :2] - start
    distance = np.linalg.norm(offset, axis=1)
    ahead = offset @ front >= _MIN_FACING * np.maximum(distance, 1e-9)
    return float(distance[ahead].min(initial=np.inf))
