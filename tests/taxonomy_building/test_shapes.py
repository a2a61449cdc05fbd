"""Shapes of classes: given, measured in scans and on meshes, or made by a model."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.semantics.taxonomy_building.measured_shapes import (
    LabelledScan,
    MeshShapes,
    ScanShapes,
    labelled_scan,
)
from toolkit.semantics.taxonomy_building.shape_statistics import (
    STATISTICS,
    instances,
    shape_statistics,
)
from toolkit.semantics.taxonomy_building.shapes import GivenShapes, read_shape_table

UP = np.array([0.0, 0.0, 1.0])


def box(*extents_m, centre=(0, 0, 0), count=4000, seed=0):
    """Points in a box."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.5, 0.5, (count, 3)) * extents_m + centre


def turned(points, seed=0):
    """Points turned anyhow."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return points @ rotation.T


def statistics(points, up=UP, floor_m=0.0):
    return dict(zip(STATISTICS, shape_statistics(points, up, floor_m), strict=True))


def test_extents_are_the_oriented_box_s_however_it_is_turned():
    for seed in range(3):
        found = statistics(turned(box(2.0, 1.0, 0.5, count=20000), seed))
        assert found["middle extent by longest"] == pytest.approx(0.5, abs=0.03)
        assert found["shortest extent by longest"] == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize(
    ("extents", "strongest"),
    [((2, 0.05, 0.05), "linearity"), ((2, 2, 0.01), "planarity"), ((1, 1, 1), "sphericity")],
)
def test_sticks_boards_and_cubes_differ(extents, strongest):
    found = statistics(turned(box(*extents)))
    names = ("linearity", "planarity", "sphericity")
    assert max(names, key=lambda name: found[name]) == strongest
    assert sum(found[name] for name in names) == pytest.approx(1, abs=1e-6)


def test_a_table_top_is_level_and_a_picture_upright():
    assert statistics(box(1, 1, 0.01))["levelness"] == pytest.approx(1, abs=0.01)
    assert statistics(box(1, 0.01, 1))["levelness"] == pytest.approx(0, abs=0.02)


def test_heights_count_from_the_floor():
    lamp = statistics(box(0.3, 0.3, 1.0, centre=(0, 0, 1.5)), floor_m=-0.5)
    assert lamp["bottom above floor (m)"] == pytest.approx(1.5, abs=0.01)
    assert lamp["height by longest extent"] == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("points", [box(1, 1, 0), box(1, 0, 0), np.zeros((10, 3))])
def test_exact_planes_lines_and_points_have_statistics(points):
    assert np.isfinite(shape_statistics(points, UP)).all()


def test_objects_of_a_class_are_separated_and_crumbs_ignored():
    two = [box(0.5, 0.5, 0.5, count=800), box(0.5, 0.5, 0.5, centre=(2, 0, 0), count=500)]
    crumbs = box(0.05, 0.05, 0.05, centre=(0, 3, 0), count=12)
    pieces = instances(np.concatenate([two[1], crumbs, two[0]]), gap_m=0.15)
    assert [len(p) for p in pieces] == [800, 500]
    assert [len(p) for p in instances(crumbs, gap_m=0.15)] == [12]
    assert instances(crumbs[:5], gap_m=0.15) == []


def room(up_axis=2):
    """A floor, a wall, two chairs; up along an axis."""
    parts = [
        (1, box(4, 4, 0.01, seed=1)),
        (2, box(4, 0.01, 2.5, centre=(0, 2, 1.25), seed=2)),
        (3, box(0.5, 0.5, 0.9, centre=(-1, 0, 0.45), seed=3)),
        (3, box(0.5, 0.5, 0.9, centre=(1, 0, 0.45), seed=4)),
    ]
    points = np.roll(np.concatenate([p for _, p in parts]), up_axis - 2, axis=1)
    ids = np.concatenate([np.full(len(p), number) for number, p in parts])
    return LabelledScan(points, ids, {1: "Floor", 2: "wall", 3: "dining-chair", 4: "vase"})


@pytest.mark.parametrize("up_axis", [0, 1, 2])
def test_the_floor_says_where_up_is(up_axis):
    up, floor_m = room(up_axis).up_and_floor()
    np.testing.assert_allclose(up, np.eye(3)[up_axis], atol=0.01)
    assert floor_m == pytest.approx(0, abs=0.02)


def test_classes_in_a_scan_are_measured_object_by_object():
    shapes = ScanShapes([room()], gap_m=0.2)
    found = shapes.embeddings(["dining chair", "wall", "vase", "unicorn"])
    assert set(found) == {"dining chair", "wall"}
    chair = dict(zip(STATISTICS, found["dining chair"], strict=True))
    # Two chairs taken for one would be 2.5 m wide and level.
    assert chair["middle extent by longest"] == pytest.approx(0.55, abs=0.08)
    assert chair["bottom above floor (m)"] == pytest.approx(0, abs=0.03)
    again = ScanShapes([room()], gap_m=0.2).embeddings(["dining chair"])
    assert (again["dining chair"] == found["dining chair"]).all()


def frame(labels, depth_m=1.0):
    camera = Camera(4.0, 4.0, 3.5, 2.5, 8, 6)
    rgb = np.zeros((6, 8, 3), np.float32)
    return Frame(0, 0.0, rgb, np.full((6, 8), depth_m, np.float32), camera, labels)


def test_views_vote_on_the_label_of_a_voxel():
    right, wrong = np.full((6, 8), 5, np.int32), np.full((6, 8), 7, np.int32)
    void = np.zeros((6, 8), np.int32)
    T = np.eye(4)
    T[:3, 3] = (10, -20, 30)
    scan = labelled_scan([(frame(x), T) for x in (right, wrong, right, void)], {5: "a", 7: "b"})
    assert set(scan.class_ids) == {5}
    centre = frame(right).camera.unproject(np.ones((6, 8))).reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(scan.points_m.mean(axis=0), centre + T[:3, 3], atol=0.03)


@pytest.mark.parametrize(
    ("labels", "message"), [(None, "no labels"), (np.zeros((6, 8), np.int32), "both depth and")]
)
def test_sequences_without_labels_are_refused(labels, message):
    with pytest.raises(DatasetError, match=message):
        labelled_scan([(frame(labels), np.eye(4))], {1: "a"})


def write_obj(path, extents):
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * extents
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"f {a + 1} {b + 1} {c + 1} {d + 1}" for a, b, c, d in quads]
    path.write_text("\n".join(lines))


def test_meshes_are_found_by_their_class_s_name(tmp_path):
    write_obj(tmp_path / "Tv-Stand.obj", (1.5, 0.4, 0.5))
    write_obj(tmp_path / "pole 1.obj", (0.1, 0.1, 2))
    write_obj(tmp_path / "pole_2.obj", (0.1, 0.1, 4))
    (tmp_path / "notes.txt").write_text("no mesh")
    found = MeshShapes(tmp_path).embeddings(["tv stand", "pole", "cup"])
    assert set(found) == {"tv stand", "pole"}
    pole = dict(zip(STATISTICS, found["pole"], strict=True))
    assert pole["middle extent by longest"] == pytest.approx((0.05 + 0.025) / 2, abs=0.01)
    assert pole["height by longest extent"] == pytest.approx(1, abs=0.02)
    lying = MeshShapes(tmp_path, up=(0, 2, 0)).embeddings(["pole"])["pole"]
    assert dict(zip(STATISTICS, lying, strict=True))["height by longest extent"] < 0.1


def test_folders_without_meshes_and_empty_meshes_are_refused(tmp_path):
    with pytest.raises(FormatError, match="named after a class"):
        MeshShapes(tmp_path).embeddings(["cup"])
    (tmp_path / "cup.obj").write_text("v 0 0 0\n")
    with pytest.raises(FormatError, match=r"cup\.obj: contains no triangle"):
        MeshShapes(tmp_path).embeddings(["cup"])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t.csv", "class,width,height\nTV-stand,1,2\ncup,3,4.5\n"),
        ("t.csv", "TV-stand, 1, 2\n\ncup, 3, 4.5"),
        ("t.json", '{"TV-stand": [1, 2], "cup": [3, 4.5]}'),
    ],
)
def test_tables_give_their_rows(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    found = read_shape_table(tmp_path / name).embeddings(["cup", "tv stand", "vase"])
    assert {k: v.tolist() for k, v in found.items()} == {"cup": [3, 4.5], "tv stand": [1, 2]}


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("t.csv", "", "no shape"),
        ("t.csv", "cup,1,2\nvase,1\n", "'vase' has 1 numbers, the first row 2"),
        ("t.csv", "cup,1,2\nvase,1,x\n", "row of 'vase' must contain only finite numbers"),
        ("t.csv", "cup,1,nan\n", "finite"),
        ("t.csv", "cup,1\nCup,2\n", "two rows"),
        ("t.csv", "cup\nvase\n", "only finite numbers"),
        ("t.json", '{"cup": [1, ', "cannot be read"),
        ("t.json", "[1, 2]", "no shape"),
        ("t.json", '{"cup": 1}', "only finite numbers"),
        ("t.json", '{"cup": [true, null]}', "only finite numbers"),
    ],
)
def test_broken_tables_name_themselves(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=message) as error:
        read_shape_table(tmp_path / name)
    assert str(tmp_path / name) in str(error.value)


def test_given_shapes_are_for_those_who_have_them():
    assert GivenShapes({}).embeddings(["cup"]) == {}
