"""Floor plans and the camera paths through them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms.collection import shelves_of_objects
from toolkit.datasets.synthetic_rooms.finishes import LACQUER_REFLECTANCE
from toolkit.datasets.synthetic_rooms.furnishing import furnish
from toolkit.datasets.synthetic_rooms.furniture import Workshop
from toolkit.datasets.synthetic_rooms.long_corridor import corridor_and_hall, there_and_back
from toolkit.datasets.synthetic_rooms.parts import Part, moved
from toolkit.datasets.synthetic_rooms.patches import placement
from toolkit.datasets.synthetic_rooms.paths import Gait, WayPoint
from toolkit.datasets.synthetic_rooms.ray_casting import Scene
from toolkit.datasets.synthetic_rooms.reflections import polished
from toolkit.datasets.synthetic_rooms.revisits import Revisit
from toolkit.datasets.synthetic_rooms.shell import WALL_HALF_M, Opening, RoomPlan, room_shell
from toolkit.datasets.synthetic_rooms.textures import Texture, damask, stripes, weakened
from toolkit.datasets.synthetic_rooms.visits import EYE_M, heading, look_around, looking, visit
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES, GLOSSY_CLASS_NAMES, numbered

# Numbers of objects per room; a room has about a hundred objects.
_MAX_OBJECTS = 1000
_WALL_M = 2 * WALL_HALF_M
_CORRIDOR_DEPTH_M = 1.9
_NORTH_OFFSET_M = 0.1  # offset of the camera path from the middle of a corridor
_ORBIT_RADIUS_M, _ORBIT_HEIGHT_M, _TABLE_TOP_M = 1.05, 1.15, 0.55
_ORBIT_POINTS, _ORBIT_STEP_RAD = 20, math.radians(20)
_LONG_POINTS = 160
_WALL_DISTANCE_M = 1.1
_UNCHANGED, _STEADY = Revisit(), Gait()


@dataclass(frozen=True)
class Layout:
    """Rooms and the camera path through them.

    Attributes:
        rooms: floor plans.
        room_seeds: random seed of the content of each room; rooms with the same seed, size and
            openings are identical.
        way_points: waypoints of the camera path.
        revisit: changes of the first room after half of the frames.
        gait: how the camera is carried.
    """

    rooms: tuple[RoomPlan, ...]
    room_seeds: tuple[int, ...]
    way_points: tuple[WayPoint, ...]
    revisit: Revisit = _UNCHANGED
    gait: Gait = _STEADY


def single_room() -> Layout:
    """One furnished room, 5.4 x 4.6 m, in which the camera moves along a loop."""
    openings = (Opening("north", 4.2, "window"), Opening("south", 4.4, "door"))
    plan = RoomPlan((0.0, 0.0), (5.4, 4.6), openings, "studio")
    return Layout((plan,), (0,), tuple(look_around(plan, 0.0, math.radians(368))))


def ring_of_rooms(revisit: Revisit = _UNCHANGED) -> Layout:
    """Four rooms connected in a ring; the camera returns to the first one."""
    size = (4.0, 4.0)
    pitch = (size[0] + _WALL_M) / 2
    middle = size[0] / 2
    # Counter-clockwise from the south-west; the second opening leads to the next room.
    plans = [
        RoomPlan((sx * pitch, sy * pitch), size, openings, style)
        for sx, sy, style, openings in (
            (-1, -1, "living", _ring_openings("north", "east", "south", middle)),
            (1, -1, "office", _ring_openings("west", "north", "east", middle)),
            (1, 1, "bedroom", _ring_openings("south", "west", "north", middle)),
            (-1, 1, "dining", _ring_openings("east", "south", "west", middle)),
        )
    ]
    # Rotating by the larger angle shows each room completely.
    turn = math.radians(-270)
    way_points: list[WayPoint] = []
    for number in (0, 1, 2, 3, 0):
        plan = plans[number]
        entry, leave = plan.openings[0], plan.openings[1]
        way_points += visit(
            plan, entry if way_points else None, leave, heading(plan, entry, inward=True), turn
        )
    return Layout(tuple(plans), (0, 1, 2, 3), tuple(way_points[:-2]), revisit)


def _ring_openings(entry: str, leave: str, window: str, middle: float) -> tuple[Opening, ...]:
    return (
        Opening(entry, middle, "passage"),  # type: ignore[arg-type]
        Opening(leave, middle, "passage"),  # type: ignore[arg-type]
        Opening(window, middle, "window"),  # type: ignore[arg-type]
    )


def rooms_with_corridor() -> Layout:
    """Three different rooms north of a corridor, visited one after the other."""
    return _corridor_layout(("office", "bedroom", "dining"), (1, 2, 3), (0, 1, 2))


def hall_of_rooms() -> Layout:
    """Twelve different rooms on four corridors in a row (four times `rooms_with_corridor`)."""
    styles = ("office", "bedroom", "dining", "living")
    return _corridor_layout(styles * 3, tuple(range(21, 33)), tuple(range(12)))


def twin_rooms() -> Layout:
    """Two identical rooms and a third one on a corridor, to test for perceptual aliasing.

    The camera returns to the first of the two, so there is a true and a false loop candidate.
    """
    return _corridor_layout(("office", "living", "office"), (1, 2, 1), (0, 1, 2, 0))


def twin_rooms_of_objects() -> Layout:
    """As `twin_rooms`, but the twins share walls and textures only: an office and a bedroom."""
    return _corridor_layout(("office", "living", "bedroom"), (1, 2, 1), (0, 1, 2, 0))


def orbit_of_objects() -> Layout:
    """Objects on a table in the middle of a room, around which the camera moves a little more than
    once while it looks at them, as in the film of an object."""
    openings = (Opening("north", 4.2, "window"), Opening("south", 4.4, "door"))
    plan = RoomPlan((0.0, 0.0), (5.4, 5.4), openings, "display")
    points = []
    for number in range(_ORBIT_POINTS):
        angle = _ORBIT_STEP_RAD * number
        radius = _ORBIT_RADIUS_M + 0.08 * math.sin(3.0 * number)
        height = _ORBIT_HEIGHT_M + 0.12 * math.sin(1.1 * number)
        target = 0.05 * math.sin(number), 0.05 * math.cos(2.0 * number), _TABLE_TOP_M
        points.append(
            WayPoint((radius * math.cos(angle), radius * math.sin(angle), height), target)
        )
    return Layout((plan,), (0,), tuple(points))


def still_camera() -> Layout:
    """The default room from one place: the hand shakes by a centimetre and a few degrees."""
    room = single_room()
    points = []
    for number in range(12):
        shift = 0.003 * math.sin(2.0 * number), 0.003 * math.sin(3.1 * number + 1.0)
        aim = 0.1 * math.sin(1.7 * number), 0.1 * math.sin(0.9 * number + 0.5)
        points.append(
            WayPoint((0.7 + shift[0], 0.2 + shift[1], EYE_M), (-1.3, aim[0], 0.85 + aim[1]))
        )
    return replace(room, way_points=tuple(points))


def one_room_for_long() -> Layout:
    """The default room, in which the camera moves and looks around freely, for minutes."""
    rng = np.random.default_rng(0)
    yaw, points = 0.0, []
    for _ in range(_LONG_POINTS):
        yaw += rng.uniform(-1.2, 1.2)
        x, y = rng.uniform(-0.75, 0.75, 2)
        height, pitch = EYE_M + rng.uniform(-0.2, 0.15), rng.uniform(-0.45, 0.1)
        ahead = math.cos(yaw), math.sin(yaw)
        points.append(
            WayPoint((x, y, height), (x + ahead[0], y + ahead[1], height + math.tan(pitch)))
        )
    return replace(single_room(), way_points=tuple(points))


def long_corridor(side_turn_rad: float = 0.0, stop: float | None = None) -> Layout:
    """A corridor of white panels with identical doors, at whose end the camera turns in a hall.

    Args:
        side_turn_rad: angle to the sides by which the camera turns while it walks.
        stop: fraction of the path at which it stands still; None if it does not.
    """
    plans = corridor_and_hall()
    way_points = there_and_back(*plans, side_turn_rad)
    return Layout(plans, (41, 42), way_points, gait=Gait(tilt=2.5, stop=stop))


def along_a_wall() -> Layout:
    """An empty room, in which the camera moves along a wall and shows nothing else for a while."""
    openings = (Opening("south", 1.6, "window"), Opening("south", 4.2, "door"))
    plan = RoomPlan((0.0, 0.0), (5.4, 4.6), openings, "bare")
    y = plan.size_m[1] / 2 - _WALL_DISTANCE_M
    stands = [(x, y, EYE_M + 0.15 * math.sin(4.0 * x)) for x in np.linspace(-1.6, 1.6, 9)]
    along = [WayPoint(stand, (stand[0], y + 1.0, stand[2])) for stand in stands]
    start = [looking((-0.2, -0.3), -1.7), looking((-1.0, 0.4), -2.6), looking((-1.6, 0.9), -4.0)]
    end = [looking((1.6, 0.9), -5.4), looking((1.0, 0.4), -6.8), looking((-0.2, -0.3), -7.9)]
    return Layout((plan,), (43,), (*start, *along, *end))


def _corridor_layout(
    styles: tuple[str, ...], room_seeds: tuple[int, ...], visits: tuple[int, ...]
) -> Layout:
    """Create rooms in a row along x; three at a time share a corridor in the south."""
    size = (4.2, 4.0)
    pitch = size[0] + _WALL_M
    door = size[0] / 2
    openings = (Opening("south", door, "passage"), Opening("north", 2.2, "window"))
    rooms = [
        RoomPlan((number * pitch, 0.0), size, openings, style)
        for number, style in enumerate(styles)
    ]
    corridors = [
        _corridor(rooms[first : first + 3], first > 0, first + 3 < len(rooms))
        for first in range(0, len(rooms), 3)
    ]
    way_points: list[WayPoint] = []
    for place, number in enumerate(visits):
        room = rooms[number]
        entry, north = room.openings[0], math.pi / 2
        way_points += visit(room, entry if way_points else None, entry, north, math.pi)
        if place + 1 < len(visits):
            way_points += _walk_corridor(corridors[0], room, rooms[visits[place + 1]])
    bare = tuple(range(9, 9 + len(corridors)))
    return Layout((*rooms, *corridors), (*room_seeds, *bare), tuple(way_points))


def _corridor(rooms: list[RoomPlan], west: bool, east: bool) -> RoomPlan:
    """Create the corridor south of a row of rooms, open to the corridors in the west and east."""
    width, depth = rooms[0].size_m
    left, right = rooms[0].centre_m[0], rooms[-1].centre_m[0]
    centre = ((left + right) / 2, -(depth + _CORRIDOR_DEPTH_M) / 2 - _WALL_M)
    openings = [Opening("north", room.centre_m[0] - left + width / 2, "passage") for room in rooms]
    # On the camera path. Positions are measured from a wall's left end as seen from inside, which
    # is the southern end in the west.
    if west:
        openings.append(Opening("west", _CORRIDOR_DEPTH_M / 2 + _NORTH_OFFSET_M, "passage"))
    if east:
        openings.append(Opening("east", _CORRIDOR_DEPTH_M / 2 - _NORTH_OFFSET_M, "passage"))
    size = (right - left + width, _CORRIDOR_DEPTH_M)
    return RoomPlan(centre, size, tuple(openings), "corridor")


def _walk_corridor(corridor: RoomPlan, start: RoomPlan, end: RoomPlan) -> list[WayPoint]:
    """Return the waypoints in the corridor from one room's door to the next."""
    y = corridor.centre_m[1] + _NORTH_OFFSET_M
    x0, x1 = start.centre_m[0], end.centre_m[0]
    east = x1 > x0
    ahead, door = (0.0, 0.6) if east else (math.pi, math.pi - 0.6)
    step = 0.35 if east else -0.35
    stands = np.linspace(x0 + step, x1 - step, 4)
    return [looking((x, y), ahead if abs(x1 - x) > 0.6 else door) for x in stands]


def build_parts(
    layout: Layout, seed: int, collection: Sequence[str] | None = None, later: bool = False
) -> list[Part]:
    """Create all surfaces of a layout; see `build_scene`."""
    parts: list[Part] = []
    for number, (plan, look) in enumerate(zip(layout.rooms, layout.room_seeds, strict=True)):
        # Built at the origin, so that identical rooms are bit-identical before they are placed.
        shop = Workshop(np.random.default_rng([seed, 1, look]))
        at_origin = replace(plan, centre_m=(0.0, 0.0))
        room = shop.as_objects(room_shell(at_origin, shop))
        changed = later and number == 0
        if collection is None:
            room += furnish(at_origin, shop, rearranged=changed and layout.revisit.moved)
        else:
            room += shelves_of_objects(at_origin, shop, collection)
        if changed:
            room = layout.revisit.appearance(room, seed)
        parts += moved(_of_room(number, room), placement(*plan.centre_m))
    return parts


def _of_room(number: int, parts: list[Part]) -> list[Part]:
    """Parts of a room, whose objects have other numbers than those of other rooms."""
    first = number * _MAX_OBJECTS
    return [replace(part, object_id=first + part.object_id) for part in parts]


def lamp_places(rooms: tuple[RoomPlan, ...]) -> NDArray[np.float64]:
    """Return the centres [L, 3] of the ceiling lamps, metres; long rooms have several."""
    lamps = []
    for plan in rooms:
        (x, y), (width, _) = plan.centre_m, plan.size_m
        count = plan.lamps or max(1, round(width / 5.0))
        for number in range(count):
            along = x + width * ((number + 0.5) / count - 0.5)
            lamps.append([along, y, plan.height_m - 0.15])
    return np.array(lamps)


@dataclass(frozen=True)
class Look:
    """Properties of all surfaces of a layout.

    Attributes:
        texture: a key of TEXTURES.
        glossy: floors, screens and mirrors reflect the scene; only in furnished rooms.
        polish: reflectance of the lacquered floors at normal incidence.
    """

    texture: str = "normal"
    glossy: bool = False
    polish: float = LACQUER_REFLECTANCE


def build_scene(
    layout: Layout,
    seed: int,
    texel_m: float,
    look: Look | None = None,
    collection: Sequence[str] | None = None,
    later: bool = False,
) -> Scene:
    """Build the textured and lit scene of a layout.

    Args:
        layout: rooms and camera path.
        seed: of furniture and textures.
        texel_m: edge of a texel, metres.
        look: of the surfaces; by default, textures are normal and nothing reflects.
        collection: class names of rooms with shelves of objects (`collection.class_names`); None
            for furnished rooms with the classes of Replica.
        later: as it is in the second half of the frames; see `Layout.revisit`.
    """
    look = look or Look()
    contrast = TEXTURES[look.texture]
    if look.texture in WALL_PAPERS:
        papered = tuple(replace(plan, wall=WALL_PAPERS[look.texture]) for plan in layout.rooms)
        layout = replace(layout, rooms=papered)
    names = collection or (GLOSSY_CLASS_NAMES if look.glossy else CLASS_NAMES)
    parts = build_parts(layout, seed, collection, later)
    if contrast < 1.0:
        kept = PLAIN_CLASSES if look.texture == "plain" else names
        parts = [
            replace(part, texture=weakened(part.texture, contrast))
            if part.class_name in kept
            else part
            for part in parts
        ]
    if look.glossy:
        parts = polished(parts)
    lamps_m = lamp_places(layout.rooms)
    if later:
        first = layout.rooms[0]
        own, others = lamp_places((first,)), lamp_places(layout.rooms[1:])
        lamps_m = np.concatenate([layout.revisit.lamps_m(first, own), others])
    polish = look.polish if look.glossy else None
    return Scene(parts, lamps_m, texel_m, numbered(names), polish)


# The fraction of each texture's contrast that is kept: of all surfaces, or of those around a room.
TEXTURES: dict[str, float] = {
    "normal": 1.0,
    "weak": 0.1,
    "plain": 0.0,
    "wallpaper": 1.0,
    "stripes": 1.0,
}
PLAIN_CLASSES = ("wall", "ceiling", "floor", "door")
# Textures of all walls. The period is a whole number of texels in images of 320 and 640 pixels.
WALL_PERIOD_M = 0.125
WALL_PAPERS: dict[str, Texture] = {
    "wallpaper": damask((0.76, 0.72, 0.62), (0.5, 0.42, 0.34), WALL_PERIOD_M, grain=0.0),
    "stripes": stripes((0.76, 0.72, 0.62), (0.5, 0.56, 0.6), WALL_PERIOD_M, grain=0.0),
}


LAYOUTS: dict[str, Callable[[], Layout]] = {
    "room": single_room,
    "rooms": rooms_with_corridor,
    "ring": ring_of_rooms,
    "ring-moved": lambda: ring_of_rooms(Revisit(moved=True)),
    "ring-light": lambda: ring_of_rooms(Revisit(dark=True)),
    "ring-evening": lambda: ring_of_rooms(Revisit(moved=True, evening=True)),
    "ring-repainted": lambda: ring_of_rooms(Revisit(evening=True, repainted=True)),
    "ring-changed": lambda: ring_of_rooms(Revisit(moved=True, evening=True, repainted=True)),
    "twins": twin_rooms,
    "twins-objects": twin_rooms_of_objects,
    "hall": hall_of_rooms,
    "orbit": orbit_of_objects,
    "still": still_camera,
    "long": one_room_for_long,
    "corridor": long_corridor,
    "corridor-turns": lambda: long_corridor(side_turn_rad=1.5),
    "corridor-stop": lambda: long_corridor(stop=0.2),
    "wall": along_a_wall,
}
