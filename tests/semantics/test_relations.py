"""Relations between simple bodies whose arrangement is known."""

from __future__ import annotations

import numpy as np
import pytest
from labelled_room import T_MAP_ROOM, sheet, table

from toolkit.base.geometry import se3
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.relations import Relation, RelationOptions
from toolkit.scene.graph.scene_relations import SceneRelations
from toolkit.scene.graph.storeys import Floors, Storeys

GROUND = Ground(T_MAP_ROOM[:3, 2], float(T_MAP_ROOM[:3, 3] @ T_MAP_ROOM[:3, 2]))
TABLE_TOP_M = 0.75


def box(x: float, y: float, z: float, size: float, lid: bool = True) -> np.ndarray:
    """Surface of a cube, its lower corner at a place; z is up."""
    a, b, c = (size, 0, 0), (0, size, 0), (0, 0, size)
    sides = [
        sheet((x, y, z), a, c, 0.02),
        sheet((x, y + size, z), a, c, 0.02),
        sheet((x, y, z), b, c, 0.02),
        sheet((x + size, y, z), b, c, 0.02),
        sheet((x, y, z), a, b, 0.02),
    ]
    return np.concatenate([*sides, sheet((x, y, z + size), a, b, 0.02)] if lid else sides)


def related_bodies(points, roles, options=None, cameras_m=None) -> list[Relation]:
    """Relations between bodies by their numbers."""
    related = SceneRelations(points.__getitem__, options)
    for number, role in enumerate(roles):
        related.changed(number, role)
    floors = Floors(GROUND, Storeys([GROUND.height_m]))
    related.update(floors, np.zeros((0, 3)) if cameras_m is None else cameras_m)
    return related.relations()


def found(options: RelationOptions | None = None, **bodies: np.ndarray) -> set[tuple]:
    """Relations by name; bodies called floor or wall have that role."""
    names = list(bodies)
    roles = [name if name in ("floor", "wall") else "object" for name in names]
    points = [se3.transform_points(T_MAP_ROOM, body) for body in bodies.values()]
    return {
        (names[r.source], r.kind, names[r.target]) for r in related_bodies(points, roles, options)
    }


FLOOR = sheet((0, 0, 0), (4, 0, 0), (0, 3, 0))


def test_things_stand_on_what_is_below_them():
    cup = box(2.0, 1.3, TABLE_TOP_M + 0.01, 0.1)
    assert found(floor=FLOOR, table=table(1.5, 1.0), cup=cup) == {
        ("table", "on", "floor"),
        ("cup", "on", "table"),
    }


def test_a_cup_on_a_book_is_not_on_the_table_below_the_book():
    book = np.concatenate(
        [sheet((1.9, 1.2, TABLE_TOP_M + h), (0.3, 0, 0), (0, 0.3, 0)) for h in (0.01, 0.04)]
    )
    cup = box(2.0, 1.3, TABLE_TOP_M + 0.05, 0.1)
    related = found(floor=FLOOR, table=table(1.5, 1.0), book=book, cup=cup)
    assert {("cup", "on", "book"), ("book", "on", "table")} <= related
    assert ("cup", "on", "table") not in related


def test_a_comforter_is_on_the_bed_of_which_it_leaves_the_sides_visible():
    long, high = (2.0, 0, 0), (0, 0, 0.5)
    bed = [sheet((1.0, y, 0.0), long, high) for y in (1.0, 2.4)]
    bed += [sheet((1.0, 1.0, 0.0), (0, 1.4, 0), (0, 0, 0.9))]
    comforter = sheet((1.1, 0.98, 0.52), (1.9, 0, 0), (0, 1.44, 0))
    related = found(floor=FLOOR, bed=np.concatenate(bed), comforter=comforter)
    assert ("comforter", "on", "bed") in related and ("comforter", "next to", "bed") not in related


@pytest.mark.parametrize("gap_m", [0.0, 0.05])
def test_the_gap_of_a_contact_is_an_option(gap_m):
    cup = box(2.0, 1.3, TABLE_TOP_M + gap_m, 0.1)
    strict = RelationOptions(contact_m=0.03, next_to_m=0.01)
    related = ("cup", "on", "table") in found(strict, table=table(1.5, 1.0), cup=cup)
    assert related == (gap_m < 0.03)


def test_things_are_in_what_surrounds_them():
    bin_, ball = box(1.0, 1.0, 0.0, 0.4, lid=False), box(1.15, 1.15, 0.03, 0.1)
    assert found(floor=FLOOR, bin=bin_, ball=ball) == {
        ("bin", "on", "floor"),
        ("ball", "in", "bin"),
    }


def test_a_table_does_not_contain_what_is_below_it():
    below = box(2.0, 1.3, 0.0, 0.2)
    assert ("crate", "in", "table") not in found(floor=FLOOR, table=table(1.5, 1.0), crate=below)


def test_neighbours_are_next_to_each_other_once_and_also_to_walls():
    wall = sheet((0, 0, 0), (4, 0, 0), (0, 0, 2.5))
    near, far = box(1.0, 0.1, 0.0, 0.4), box(3.0, 1.5, 0.0, 0.4)
    beside = box(1.5, 0.1, 0.0, 0.4)
    related = found(floor=FLOOR, wall=wall, a=near, b=beside, c=far)
    assert {r for r in related if r[1] == "next to"} == {
        ("wall", "next to", "a"),
        ("wall", "next to", "b"),
        ("a", "next to", "b"),
    }
    assert not any(source in ("floor", "wall") and kind == "on" for source, kind, _ in related)


def seat(x: float, y: float, back_y: float) -> np.ndarray:
    """A chair of 0.5 m with its back at one side; z is up."""
    return np.concatenate(
        [
            sheet((x, y, 0.45), (0.5, 0, 0), (0, 0.5, 0), 0.02),
            sheet((x, back_y, 0), (0.5, 0, 0), (0, 0, 0.9), 0.02),
        ]
    )


def test_lamps_hang_above_tables_but_cups_stand_on_them():
    bodies = {"table": table(1.5, 1.0), "lamp": box(2.0, 1.3, 1.6, 0.2)}
    relation = ("lamp", "above", "table")
    assert relation in found(floor=FLOOR, **bodies)
    shifted = {**bodies, "lamp": box(3.2, 1.3, 1.6, 0.2)}
    assert relation not in found(floor=FLOOR, **shifted)
    bodies["lamp"] = box(2.0, 1.3, TABLE_TOP_M + 0.01, 0.2)
    assert relation not in found(floor=FLOOR, **bodies)


@pytest.mark.parametrize(("back_y", "faces"), [(0.2, True), (0.7, False)])
def test_chairs_face_what_is_before_them(back_y, faces):
    bodies = {"table": table(1.5, 1.0), "chair": seat(1.9, 0.2, back_y)}
    assert (("chair", "facing", "table") in found(floor=FLOOR, **bodies)) == faces


def test_cabinets_have_no_front():
    bodies = {"table": table(1.5, 1.0), "cabinet": box(1.9, 0.2, 0.0, 0.5)}
    assert not any(kind == "facing" for _, kind, _ in found(floor=FLOOR, **bodies))


@pytest.mark.parametrize(("camera_y", "faces"), [(1.5, True), (-1.5, False)])
def test_screens_face_the_side_from_which_they_are_seen(camera_y, faces):
    screen = sheet((1.6, 0.0, 0.9), (1.0, 0, 0), (0, 0, 0.6), 0.02)
    bodies = [FLOOR, table(1.5, 1.0), screen]
    points = [se3.transform_points(T_MAP_ROOM, body) for body in bodies]
    camera = se3.transform_points(T_MAP_ROOM, np.array([[2.0, camera_y, 1.5]]))
    related = related_bodies(points, ["floor", "object", "object"], None, camera)
    assert any(r.kind == "facing" and (r.source, r.target) == (2, 1) for r in related) == faces


def test_pictures_face_away_from_their_wall_wherever_it_is_seen_from():
    wall = np.concatenate([sheet((0, y, 0), (4, 0, 0), (0, 0, 2.5)) for y in (-0.1, 0.0)])
    picture = sheet((1.6, 0.02, 1.2), (1.0, 0, 0), (0, 0, 0.6), 0.02)
    before, behind = table(1.5, 1.0), table(1.5, -2.0)
    points = [se3.transform_points(T_MAP_ROOM, b) for b in (FLOOR, wall, picture, before, behind)]
    camera = se3.transform_points(T_MAP_ROOM, np.array([[2.0, -2.5, 1.5]]))
    related = related_bodies(points, ["floor", "wall", *["object"] * 3], None, camera)
    assert {r.target for r in related if r.source == 2 and r.kind == "facing"} == {3}


def shelf(z: float = 0.0) -> np.ndarray:
    """The front edges of a shelf with boards 0.4 m apart: what a camera sees of a full one."""
    boards = [sheet((1.0, 0.25, z + 0.4 * k), (1.0, 0, 0), (0, 0.05, 0), 0.02) for k in range(3)]
    sides = [sheet((x, 0.25, z), (0, 0.05, 0), (0, 0, 0.8), 0.02) for x in (1.0, 2.0)]
    return np.concatenate([*boards, *sides])


def test_books_are_in_the_shelf_between_its_boards_and_on_its_top():
    books = sheet((1.2, 0.25, 0.42), (0.5, 0, 0), (0, 0, 0.3), 0.02)
    top = sheet((1.2, 0.26, 0.82), (0.5, 0, 0), (0, 0, 0.2), 0.02)
    related = found(shelf=shelf(), books=books, top=top)
    assert ("books", "in", "shelf") in related
    assert ("top", "on", "shelf") in related
    assert not any(r[0] == "shelf" and r[1] in ("on", "in") for r in related)


def test_a_chair_faces_the_shelf_and_not_the_books_in_it():
    books = sheet((1.2, 0.25, 0.42), (0.5, 0, 0), (0, 0, 0.3), 0.02)
    chair = seat(1.2, 1.0, 1.5)
    related = found(shelf=shelf(), books=books, chair=chair)
    assert {r for r in related if r[1] == "facing"} == {("chair", "facing", "shelf")}


def test_a_plate_does_not_contain_what_is_higher_than_its_rim():
    plate, cake = box(1.0, 1.0, 0.0, 0.4, lid=False), box(1.1, 1.1, 0.02, 0.2)
    low = plate[plate[:, 2] < 0.1]
    assert ("cake", "in", "plate") not in found(plate=low, cake=cake)


def test_furniture_stands_on_the_floor_that_it_hides():
    hidden = FLOOR[~((FLOOR[:, :2] > [1.0, 1.0]) & (FLOOR[:, :2] < [2.0, 2.0])).all(axis=1)]
    chest = box(1.0, 1.0, 0.0, 1.0)
    assert ("chest", "on", "floor") in found(floor=hidden, chest=chest)


def test_things_beside_each_other_on_a_table_do_not_support_each_other():
    bodies = {"a": box(2.0, 1.3, TABLE_TOP_M, 0.1), "b": box(2.08, 1.3, TABLE_TOP_M, 0.1)}
    related = found(table=table(1.5, 1.0), **bodies)
    assert {r for r in related if r[1] == "on"} == {("a", "on", "table"), ("b", "on", "table")}


def test_pictures_hang_at_walls_but_cupboards_do_not():
    wall = sheet((0, 0, 0), (4, 0, 0), (0, 0, 2.5))
    picture = sheet((1.0, 0.03, 1.2), (0.6, 0, 0), (0, 0, 0.4), 0.02)
    cupboard = box(2.0, 0.05, 1.0, 0.6)
    related = found(wall=wall, picture=picture, cupboard=cupboard)
    assert ("picture", "on", "wall") in related
    assert ("cupboard", "on", "wall") not in related


def test_beds_have_no_front_although_they_have_a_back():
    bed = np.concatenate(
        [sheet((1, 0.2, 0.5), (1.6, 0, 0), (0, 2.0, 0)), sheet((1, 0.2, 0), (1.6, 0, 0), (0, 0, 1))]
    )
    stool = box(1.5, 2.4, 0.0, 0.4)
    assert not any(kind == "facing" for _, kind, _ in found(bed=bed, stool=stool))


def test_a_sofa_with_arms_faces_the_table_and_not_its_cushion():
    sofa = np.concatenate(
        [
            sheet((1, 0.2, 0.45), (2.0, 0, 0), (0, 0.8, 0), 0.02),
            sheet((1, 0.2, 0.0), (2.0, 0, 0), (0, 0, 0.8), 0.02),
            sheet((1, 0.2, 0.62), (0.2, 0, 0), (0, 0.8, 0), 0.02),
            sheet((2.8, 0.2, 0.62), (0.2, 0, 0), (0, 0.8, 0), 0.02),
        ]
    )
    cushion, stool = box(1.9, 0.7, 0.47, 0.2), box(1.8, 1.4, 0.0, 0.4)
    related = found(sofa=sofa, cushion=cushion, stool=stool)
    assert {r for r in related if r[1] == "facing"} == {("sofa", "facing", "stool")}


def test_a_screen_does_not_face_the_cabinet_below_it():
    screen = sheet((1.6, 0.0, 1.0), (1.0, 0, 0), (0, 0, 0.6), 0.02)
    cabinet, sofa = box(1.8, 0.05, 0.0, 0.6), box(1.8, 1.4, 0.0, 0.5)
    points = [se3.transform_points(T_MAP_ROOM, b) for b in (FLOOR, screen, cabinet, sofa)]
    camera = se3.transform_points(T_MAP_ROOM, np.array([[2.0, 2.5, 1.5]]))
    roles = ["floor", "object", "object", "object"]
    related = related_bodies(points, roles, None, camera)
    assert {(r.source, r.kind, r.target) for r in related if r.source == 1} == {
        (1, "above", 2),
        (1, "facing", 3),
    }
