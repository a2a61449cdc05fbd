"""Relations between all objects of a scene, which may grow: some objects are compared at a time.

The relations are geometric: they are derived from points of the objects above the plane of the
floor, and need no knowledge about classes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.graph.bodies import Body
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.facing import front_of
from toolkit.scene.graph.relations import (
    MAX_FACED_M,
    REACH_CONTACTS,
    Groups,
    Relation,
    RelationOptions,
    Role,
    highest_below,
    may_be_near,
    nearest_ahead,
    support,
    wall_behind,
)
from toolkit.scene.graph.storeys import Floors, Storeys

Array = NDArray[np.float64]

# Objects beyond this distance horizontally cannot be below an object.
_BELOW_M = 0.1


class SceneRelations:
    """Relations between objects by number.

    An object is in another one that surrounds it, else on the one with points right below its
    bottom, else on the floor around it, else on the wall that it hangs at. Objects are next to each
    other if neither supports or contains the other and they are close; such pairs are reported
    once. Walls and floors are neither on nor in anything. Objects can be next to walls, but not to
    floors. An object is above the highest one below it that does not support it, and seats and
    panels face the nearest object before them that is not of their own group.

    Args:
        points_of: points [n, 3] of an object in the world, by its number.
        options: options of the relations.
    """

    def __init__(
        self, points_of: Callable[[int], Array], options: RelationOptions | None = None
    ) -> None:
        self._points_of, self._options = points_of, options or RelationOptions()
        # Objects beyond this distance can neither support nor contain an object.
        self._reach_m = REACH_CONTACTS * self._options.contact_m
        self._bodies: dict[int, Body] = {}
        self._outdated: set[int] = set()
        self._roles: dict[int, Role] = {}
        self._vertical: dict[int, list[Relation]] = {}
        self._above: dict[int, int] = {}
        self._facing: dict[int, int] = {}
        self._near: set[tuple[int, int]] = set()
        self._waiting: dict[int, None] = {}

    def __len__(self) -> int:
        """Number of objects that wait to be compared."""
        return len(self._waiting)

    def changed(self, number: int, role: Role) -> None:
        """Note that an object is new or has changed.

        Args:
            role: ceilings count as floors.
        """
        self._roles[number] = role
        self._outdated.add(number)
        self._waiting.setdefault(number)

    def all_changed(self) -> None:
        """Note that all objects have moved, such as by a correction of loops."""
        self._bodies.clear()
        for number in self._roles:
            self._waiting.setdefault(number)

    def remove(self, number: int) -> None:
        """Forget an object that became part of another one."""
        for table in (self._bodies, self._roles, self._vertical, self._above, self._facing):
            table.pop(number, None)
        self._waiting.pop(number, None)
        self._outdated.discard(number)
        self._near = {pair for pair in self._near if number not in pair}
        for source, found in self._vertical.items():
            self._vertical[source] = [r for r in found if r.target != number]
        for targets in (self._above, self._facing):
            for source in [s for s, target in targets.items() if target == number]:
                del targets[source]

    def update(self, floors: Floors, cameras_m: Array, count: int | None = None) -> None:
        """Compare the objects that wait longest with all others.

        Args:
            floors: planes of the floors; objects of different storeys have no relations.
            cameras_m: [P, 3] positions of the camera, which panels face that hang at no wall;
                without them, these have no front.
            count: maximum number of objects; all if None.
        """
        chosen = list(self._waiting)[:count]
        for number in self._roles if count is None else ():
            self._body(number, floors.ground)
        neighbours = [self._compare(number, floors) for number in chosen]
        # What stands on what is known: an object does not face those of its own group.
        for number, near in zip(chosen, neighbours, strict=True):
            if self._roles[number] == "object":
                self._face(number, near, floors, cameras_m)

    def relations(self) -> list[Relation]:
        """All relations, in a fixed order."""
        found = [r for number in sorted(self._vertical) for r in self._vertical[number]]
        linked = {frozenset((r.source, r.target)) for r in found}
        near = [p for p in sorted(self._near) if frozenset(p) not in linked]
        found += [Relation(a, b, "next to") for a, b in near]
        found += [Relation(a, b, "above") for a, b in sorted(self._above.items())]
        return found + [Relation(a, b, "facing") for a, b in sorted(self._facing.items())]

    def _body(self, number: int, ground: Ground) -> Body:
        """The body of an object along the axes of the floor."""
        if number not in self._bodies or number in self._outdated:
            self._bodies[number] = Body(self._points_of(number) @ ground.axes)
            self._outdated.discard(number)
        return self._bodies[number]

    def _compare(self, number: int, floors: Floors) -> list[int]:
        """Compare an object with those around it; return those that it may face."""
        del self._waiting[number]
        is_new = number not in self._bodies
        body = self._body(number, floors.ground)
        others = [k for k in self._bodies if k != number]
        if not others:
            return []
        low, high = (
            np.array([getattr(self._bodies[k], s) for k in others]) for s in ("low", "high")
        )
        gap = np.maximum(low - body.high, body.low - high)
        numbers = np.array(others)
        close = numbers[(gap <= max(self._reach_m, self._options.next_to_m)).all(axis=1)].tolist()
        close = self._meeting(number, close, floors.storeys)
        self._pair_up(number, close)
        if self._roles[number] in ("object", "opening"):
            self._vertical[number] = support(
                number, close, self._bodies, self._roles, self._options
            )
        if is_new:  # its neighbours may stand on it
            around = numbers[(gap <= self._reach_m).all(axis=1)].tolist()
            for k in around:
                if self._roles[k] == "object":
                    self._waiting.setdefault(k)
        if self._roles[number] != "object":
            return []
        flat = (gap[:, :2] <= _BELOW_M).all(axis=1)
        self._hang(number, self._meeting(number, numbers[flat].tolist(), floors.storeys))
        near = numbers[(gap[:, :2] <= self._options.facing_m).all(axis=1)].tolist()
        return self._meeting(number, near, floors.storeys)

    def _meeting(self, number: int, others: list[int], storeys: Storeys) -> list[int]:
        """Those of some objects that are on a storey of an object; floors touch or do not."""
        if len(storeys) == 1 or self._roles[number] == "floor":
            return others
        own = self._storeys_of(number, storeys)
        return [
            k
            for k in others
            if self._roles[k] == "floor" or any(s in own for s in self._storeys_of(k, storeys))
        ]

    def _storeys_of(self, number: int, storeys: Storeys) -> range:
        body = self._bodies[number]
        if self._roles[number] != "object":
            return storeys.reached(body.bottom, body.top)
        storey = storeys.of(body.bottom, body.top)
        return range(storey, storey + 1)

    def _pair_up(self, number: int, close: list[int]) -> None:
        self._near = {pair for pair in self._near if number not in pair}
        for k in close:
            if may_be_near(self._roles[number], self._roles[k]) and self._bodies[number].near(
                self._bodies[k], self._options.next_to_m
            ):
                self._near.add((min(number, k), max(number, k)))

    def _hang(self, number: int, below: list[int]) -> None:
        self._above.pop(number, None)
        if any(self._roles[r.target] != "wall" for r in self._vertical.get(number, [])):
            return
        things = [k for k in below if self._roles[k] == "object"]
        target = highest_below(number, things, self._bodies)
        if target is not None:
            self._above[number] = target

    def _face(self, number: int, near: list[int], floors: Floors, cameras_m: Array) -> None:
        self._facing.pop(number, None)
        # What is in a shelf neither faces anything nor is faced: the shelf is.
        contained = {k for k, found in self._vertical.items() if any(r.kind == "in" for r in found)}
        if number in contained:
            return
        body = self._bodies[number]
        ground = floors.of(floors.storeys.of(body.bottom, body.top))
        floor = np.array([0.0, 0.0, ground.height_m])
        hanging = self._vertical.get(number, ())
        wall = wall_behind(body, hanging, self._bodies, self._roles) - floor
        front = front_of(body.points - floor, cameras_m @ ground.axes - floor, wall)
        if front is None:
            return
        vertical = [r for found in self._vertical.values() for r in found]
        vertical += [Relation(a, b, "above") for a, b in self._above.items()]
        groups = Groups(vertical, self._roles)
        things = [
            k
            for k in near
            if self._roles[k] == "object"
            and k not in contained
            and self._bodies[k].bottom - ground.height_m <= MAX_FACED_M
            and not groups.same(number, k)
        ]
        target = nearest_ahead(body, front, things, self._bodies, self._options.facing_m)
        if target is not None:
            self._facing[number] = target

    def values(self) -> dict[str, Any]:
        """JSON values of a checkpoint."""
        vertical = [r for found in self._vertical.values() for r in found]
        return {
            "roles": [[k, role] for k, role in self._roles.items()],
            "sources": list(self._vertical),
            "vertical": [[r.source, r.target, r.kind] for r in vertical],
            "above": list(map(list, self._above.items())),
            "facing": list(map(list, self._facing.items())),
            "near": sorted(map(list, self._near)),
            "waiting": list(self._waiting),
            "outdated": sorted(self._outdated),
            "bodies": list(self._bodies),
        }

    def restore(self, values: dict[str, Any], bodies: dict[int, Body]) -> None:
        """Restore earlier `values`, with the bodies that existed then."""
        self._roles = {int(k): role for k, role in values["roles"]}
        self._vertical = {int(k): [] for k in values["sources"]}
        for a, b, kind in values["vertical"]:
            self._vertical[int(a)].append(Relation(int(a), int(b), kind))
        self._above = {int(a): int(b) for a, b in values["above"]}
        self._facing = {int(a): int(b) for a, b in values["facing"]}
        self._near = {(int(a), int(b)) for a, b in values["near"]}
        self._waiting = {int(k): None for k in values["waiting"]}
        self._outdated = {int(k) for k in values["outdated"]}
        self._bodies = {int(k): bodies[int(k)] for k in values["bodies"]}

    @property
    def bodies(self) -> dict[int, Body]:
        """The known bodies by number, as they were when they were compared."""
        return self._bodies
