"""Scene graphs of finished runs against the truth of synthetic rooms.

    python -m benchmarks.semantics.relations [--seeds 3] [--only ring]

The truth follows from the geometry of the rooms, not from the map (`relation_truth`).
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from benchmarks.semantics.relation_truth import Pair, TrueRelations
from benchmarks.shared.recordings import room, sequence_arguments
from benchmarks.shared.runner import Page
from benchmarks.shared.runs import finished_run
from benchmarks.shared.tables import Metrics, Rows, Table, table_of
from toolkit.exports.mapped_scene import MappedScene, map_scene
from toolkit.exports.options import ObjectGraphOptions
from toolkit.exports.selection import select

# Name of a sequence: its room and layout.
SEQUENCES = {
    "room": ("room-small", "room"),
    "ring": ("ring-small", "ring"),
    "hall": ("hall-short", "hall"),
}
KINDS = ("on", "in", "above", "facing", "next to", "part of", "room of", "rooms", "doors")
COLUMNS = ("true", "predicted", "precision", "recall")
MASKS = ", true masks"
# An object was seen if an image has this share of its pixels on it.
_SEEN_SHARE = 1e-3
# A point of the map belongs to the nearest true object of its class within this distance.
_MATCH_M = 0.15
_SAMPLES = 400
_MIN_IOU, _DOOR_M = 0.5, 0.5
DESCRIPTION = """\
Relations, rooms and doors of the scene graph (`semsplat export --to graph.json`) in percent of
those predicted that are true (precision), and of the true ones that are predicted (recall).
Medians over seeds. The truth is computed from the surfaces of the rooms' objects and their known
fronts, for objects that cover at least 0.1 % of an image. Objects of the map are identified with
the true object of their class that is nearest to most of their points; a relation of two objects
counts once, and one of an object that has no true counterpart is wrong. Walls and floors of
different rooms are not distinguished in relations of objects, since they are connected in a map.

"on", "in", "above", "facing", "next to": relations between objects, and of objects with walls,
doors and windows. "in" is a container, which 70 % of the directions from the top of the object
meet. "part of": classes of walls, floors, doors and windows in each room. "room of": the room of
each object. "rooms": those that overlap with a true room by at least half of their union. "doors":
passages between the right rooms, at most 0.5 m from their true place.

room is 200 frames of a furnished room, ring 450 frames through four rooms (both 160x120), hall 800
frames through twelve rooms and four corridors (120x90); all with sensor noise and given poses.
Objects are those of the classes by connection; "true masks" are objects from the true instance
images, which shows what the objects of the map cost."""


def table(found: Rows) -> Table:
    """A row for each kind of relation of each sequence."""
    rows = {
        f"{name}: {kind}": [run[kind] for run in runs]
        for name, runs in found.items()
        for kind in KINDS
        if any(run[kind]["true"] or run[kind]["predicted"] for run in runs)
    }
    return table_of(COLUMNS, rows)


def measure(job: list[str], seed: int) -> Metrics:
    """Scores of each kind of relation for a sequence."""
    name, masks = job
    sequence, layout = SEQUENCES[name]
    instances = room(sequence, seed) / "instances"
    arguments = [*sequence_arguments(sequence, seed), "--poses", "given"]
    if masks:
        arguments += ["--instances.kind", "folder", "--instances.path", str(instances)]
    with finished_run(arguments, seed) as (_, folder):
        scene = map_scene(select(folder.path), ObjectGraphOptions())
        return graph_scores(scene, TrueRelations(layout, seed, seen_objects(instances)))


def seen_objects(instances: Path) -> set[int]:
    """The numbers of the objects that are large enough in an image of a folder."""
    seen: set[int] = set()
    for file in sorted(instances.glob("*.png")):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        numbers, counts = np.unique(image, return_counts=True)
        seen |= set(numbers[counts >= _SEEN_SHARE * image.size].tolist())
    return seen - {0}


def graph_scores(scene: MappedScene, truth: TrueRelations) -> Metrics:
    """Scores of each kind of relation."""
    true_of = [matched(scene, number, truth) for number in range(len(scene.objects))]
    scores = relation_scores(scene, truth, true_of)
    rooms = _matched_rooms(scene, truth)
    scores["rooms"] = _score({k for k in rooms if k >= 0}, _seen_rooms(truth), len(rooms))
    structures, placed = set(), set()
    for number, found in enumerate(scene.objects):
        for where in (rooms[k] for k in scene.rooms_of(number)):
            if scene.enclosing[number]:
                structures.add((found.node.name, where))
            else:
                placed.add((true_of[number] or -number, where))
    scores["part of"] = _score(structures, truth.structures)
    homes = {(o.number, o.room) for o in truth.objects.values() if o.role == "object"}
    scores["room of"] = _score(placed, homes)
    scores["doors"] = _door_scores(scene, truth, rooms)
    return scores


def relation_scores(scene: MappedScene, truth: TrueRelations, true_of: list[int | None]) -> Metrics:
    """Scores of the relations between objects.

    Args:
        true_of: the true object of each object of the scene, None for none.
    """
    predicted: set[Pair] = set()
    for relation in scene.relations:
        # Objects without a counterpart have negative numbers, which no true relation has.
        a, b = (true_of[k] or -1 - k for k in (relation.source, relation.target))
        if a != b:  # two pieces of one object
            predicted.add((a, relation.kind, b))
    predicted, expected = (_of_classes(some, truth) for some in (predicted, truth.relations))
    scores = {}
    for kind in ("on", "in", "above", "facing", "next to"):
        own, true = ({r for r in some if r[1] == kind} for some in (predicted, expected))
        scores[kind] = _score(own, true)
    return scores


def _of_classes(relations: set[Pair], truth: TrueRelations) -> set[Pair]:
    """Relations with one number for all walls and one for all floors, which continue from room to
    room in a map; those that are mutual have the lower number first."""
    first: dict[str, int] = {}
    table = {}
    for one in truth.objects.values():
        shared = one.role in ("wall", "floor")
        table[one.number] = first.setdefault(one.name, one.number) if shared else one.number
    found = set()
    for a, kind, b in relations:
        a, b = table.get(a, a), table.get(b, b)
        found.add((min(a, b), kind, max(a, b)) if kind == "next to" else (a, kind, b))
    return found


def matched(scene: MappedScene, number: int, truth: TrueRelations) -> int | None:
    """The true object of an object of the map; None if most of its points are at none."""
    points_m = scene.objects[number].points_m + scene.selection.run.origin_m
    points_m = points_m[:: max(1, len(points_m) // _SAMPLES)]
    name = scene.objects[number].node.name
    same = [one for one in truth.objects.values() if one.name == name]
    if not same:
        return None
    distance_m = np.array([one.tree.query(points_m)[0] for one in same])
    nearest = distance_m.argmin(axis=0)[distance_m.min(axis=0) <= _MATCH_M]
    if len(nearest) < 0.5 * len(points_m):
        return None
    return same[int(np.bincount(nearest).argmax())].number


def _matched_rooms(scene: MappedScene, truth: TrueRelations) -> list[int]:
    """The true room of each room of the map, other negative numbers for none."""
    (space,) = scene.building.spaces
    rooms, grid = space.rooms, space.grid
    found, taken = [], set()
    for number in range(len(rooms)):
        cells = np.argwhere(rooms.numbers == number)
        places = grid.points_of(cells) + scene.selection.run.origin_m
        ((best, count),) = Counter(truth.room_at(place) for place in places[:, :2]).most_common(1)
        area = np.prod(truth.layout.rooms[best].size_m) / grid.cell_m**2 if best >= 0 else 0.0
        good = count / (len(cells) + area - count) >= _MIN_IOU and best not in taken
        found.append(best if good else -1 - number)
        taken |= {best}
    return found


def _seen_rooms(truth: TrueRelations) -> set[int]:
    """Rooms of which the images show the floor."""
    return {one.room for one in truth.objects.values() if one.name == "floor"}


def _door_scores(scene: MappedScene, truth: TrueRelations, rooms: list[int]) -> Metrics:
    (space,) = scene.building.spaces
    doors = space.rooms.doors
    cells = np.array([door.cell for door in doors], np.intp).reshape(-1, 2)
    places = space.grid.points_of(cells)[:, :2] + scene.selection.run.origin_m[:2]
    seen = _seen_rooms(truth)
    true = [door for door in truth.doors if door[0] <= seen]
    found: set[int] = set()
    for door, place in zip(doors, places, strict=True):
        pair = frozenset(rooms[k] for k in door.rooms)
        found |= {
            k
            for k, (own, centre, _) in enumerate(true)
            if own == pair and np.linalg.norm(centre - place) <= _DOOR_M
        }
    return _score(found, set(range(len(true))), len(doors))


def _score(predicted: set, true: set, count: int | None = None) -> Metrics:
    """Precision and recall in percent; `count` is the number predicted if not all are listed."""
    count = len(predicted) if count is None else count
    hits = len(predicted & true)
    return {
        "true": len(true),
        "predicted": count,
        "precision": 100.0 * hits / count if count else None,
        "recall": 100.0 * hits / len(true) if true else None,
    }


PAGE = Page(
    "relations",
    "Scene graphs",
    DESCRIPTION,
    {f"{name}{masks}": [name, masks] for name in SEQUENCES for masks in ("", MASKS)},
    measure,
    lambda rows: [table(rows)],
    seeds=3,
)

if __name__ == "__main__":
    PAGE.main()
