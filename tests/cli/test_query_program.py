"""query, and export by class: as users call them, and what they say to bad input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from labelled_room import (
    CHAIR_SIZE_M,
    IDS,
    T_MAP_ROOM,
    TABLE_SIZE_M,
    labelled,
    room_parts,
)
from labelled_run import PLACES
from test_finished_run_programs import one_line_of_error, semsplat

from toolkit.base.geometry import se3
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.splats import read_splats, write_splat_ply
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.cli.main import main


@pytest.fixture(scope="module")
def finished(labelled_run) -> Path:
    return labelled_run


@pytest.fixture
def room_run(finished, tmp_path) -> Path:
    """The run, to be damaged."""
    shutil.copytree(finished, tmp_path / "room_run")
    return tmp_path / "room_run"


def printed_json(capsys, *words: object):
    assert main(["query", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def in_room(points_m: np.ndarray) -> np.ndarray:
    return se3.transform_points(se3.inverse(T_MAP_ROOM), np.asarray(points_m, float))


def test_query_prints_the_tree_and_a_table(finished):
    done = semsplat("query", finished)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert lines[0][:2] == ["large", "items"]
    assert [
        "chair",
        str((read_splats(finished / "map.ply").labels.label == IDS["chair"]).sum()),
    ] in [line[:2] for line in lines]
    done = semsplat("query", finished, "large items > furnishings", "chair")
    assert done.returncode == 0, done.stderr
    assert "large items > furnishings: " in done.stdout
    assert "3 object(s), " in done.stdout and "m2 of floor area" in done.stdout
    assert "1.20 x 0.80 x 0.75" in done.stdout
    # The group and then the class, each with both chairs.
    assert done.stdout.count("0.48 x 0.44 x 0.90") == 4


def test_answers_as_json_hold_the_boxes(finished, capsys):
    tables, seats = printed_json(capsys, finished, "table", "seating")
    (found,) = tables["objects"]
    np.testing.assert_allclose(found["box"]["size_m"], TABLE_SIZE_M, atol=2e-3)
    np.testing.assert_allclose(in_room([found["box"]["centre_m"]])[0], (2.1, 1.4, 0.375), atol=2e-3)
    assert [o["name"] for o in seats["objects"]] == ["chair", "chair"]
    for chair in seats["objects"]:
        np.testing.assert_allclose(chair["box"]["size_m"], CHAIR_SIZE_M, atol=2e-3)


def test_distances_are_from_the_first_or_last_camera(finished, capsys):
    table_m = in_room(labelled({"table": room_parts()["table"]})[0])
    for which, place in (("first", PLACES[0]), ("last", PLACES[-1])):
        (answer,) = printed_json(capsys, finished, "table", "--distance-from", which)
        expected = np.linalg.norm(table_m - place, axis=1).min()
        assert answer["objects"][0]["distance_m"] == pytest.approx(expected, abs=1e-3)


def test_the_scene_and_clouds_are_written_beside_the_answer(finished, tmp_path, capsys):
    words = ["--summary", tmp_path / "scene.json", "--cloud", tmp_path / "chairs.ply"]
    (answer,) = printed_json(capsys, finished, "chair", *words)
    summary = json.loads((tmp_path / "scene.json").read_text())
    assert sorted(o["name"] for o in summary["objects"]) == [
        "chair",
        "chair",
        "floor",
        "table",
        "wall",
    ]
    np.testing.assert_allclose(summary["room"]["box"]["size_m"], (4.0, 3.0, 2.5), atol=5e-3)
    points_m = np.asarray(open3d().io.read_point_cloud(str(tmp_path / "chairs.ply")).points)
    assert len(points_m) == answer["gaussians"]
    assert in_room(points_m).max(axis=0) == pytest.approx((2.78, 0.74, 0.9), abs=1e-3)


def test_the_mesh_of_a_thing_is_that_thing(finished, tmp_path):
    mesh = tmp_path / "table.ply"
    assert main(["query", str(finished), "table", "--mesh", str(mesh), "--voxel-m", "0.02"]) == 0
    read = open3d().io.read_triangle_mesh(str(mesh))
    vertices_m = in_room(np.asarray(read.vertices))
    assert len(read.triangles) > 500
    low, high = np.array([1.5, 1.0, 0.0]), np.array([2.7, 1.8, 0.75])
    # Both sides of its sides are seen, which fuses to surfaces 15 cm off unless these go.
    assert ((vertices_m > low - 0.1) & (vertices_m < high + 0.1)).all()
    # Most of the board's top is there: 0.96 m2, and the sides that the cameras see.
    assert read.get_surface_area() > 0.7


def test_unsure_gaussians_can_be_left_out(room_run, capsys):
    splats = read_splats(room_run / "map.ply")
    columns = dict(splats.extra)
    chairs = np.flatnonzero(columns["label"] == IDS["chair"])
    columns["confidence"][chairs[: len(chairs) // 2]] = 0.3
    write_splat_ply(room_run / "map.ply", splats, columns)
    (answer,) = printed_json(capsys, room_run, "chair", "--min-confidence", "0.5")
    assert answer["gaussians"] == len(chairs) // 2
    assert len(answer["objects"]) == 1
    line = one_line_of_error(capsys, "query", room_run, "chair", "--min-confidence", "0.95")
    assert "contains no 'chair' with confidence 0.95 or more" in line


def test_without_a_floor_it_says_so(finished, capsys):
    assert main(["query", str(finished), "table", "--floor", "wall"]) == 0
    assert "No floor was found" in capsys.readouterr().out


def test_nouns_find_classes_by_their_meaning(finished, tmp_path, capsys):
    cloud = tmp_path / "seats.ply"
    assert main(["query", str(finished), "red armchairs", "--cloud", str(cloud)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(
        "Note: no class is called 'red armchairs'; 'armchairs' is a kind of 'chair' (lexicon).\n"
    )
    assert len(open3d().io.read_point_cloud(str(cloud)).points) == 936
    (answer,) = printed_json(capsys, finished, "furniture")
    assert answer["path"] == ["large items", "furnishings"]
    assert [path[-1] for path in answer["paths"]] == ["chair", "sofa", "table"]
    assert answer["asked"] == "furniture"
    assert "it includes 'chair', 'sofa' and 'table'" in answer["explanation"]
    assert sorted(o["name"] for o in answer["objects"]) == ["chair", "chair", "table"]
    (exact,) = printed_json(capsys, finished, "chair")
    assert "explanation" not in exact


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["couch"], "contains no 'couch' (no class is called 'couch'; 'sofa' means the same"),
        (["toaster"], "no class or group of taxonomy 'room' means 'toaster'; list its classes"),
        (["ottoman"], "near in meaning: 'chair', 'sofa' and 'table'"),
        (["x" * 10_000], "has 10000 characters; give at most 200"),
        (["\x1b[31mchair\u202e"], "no class or group '\\x1b[31mchair\\u202e'"),
        (["../../etc/passwd"], "no class or group '../../etc/passwd'"),
        (["<script>"], "no class or group '<script>'"),
        (["chiar"], "no class or group 'chiar' in taxonomy 'room'; did you mean chair"),
        (["sofa"], "contains no 'sofa'; list its classes with: semsplat query RUN --list"),
        (["chair", "sofa"], "contains no 'sofa'"),
        (["chair", "--list"], "not both"),
        (["--cloud", "a.ply"], "need the names"),
        (["chair", "--cloud", "FOLDER/a.obj"], "must end in .ply or .pcd"),
        (["chair", "--mesh", "FOLDER/no/a.ply"], "there is no folder"),
        (["--summary", "FOLDER/scene.txt"], "must end in .json"),
        (["chair", "--min-confidence", "2"], "--min-confidence"),
        (["chair", "--link-m", "0"], "--link-m"),
        (["chair", "--mesh", "FOLDER/a.ply", "--every", "0"], "--every"),
        (["chair", "--floor", "flor"], "did you mean floor"),
    ],
)
def test_bad_queries_are_reported_in_one_line(finished, tmp_path, capsys, words, said):
    words = [word.replace("FOLDER", str(tmp_path)) for word in words]
    assert said in one_line_of_error(capsys, "query", finished, *words)


def test_runs_without_labels_or_their_tree_say_what_to_do(room_run, run, capsys):
    line = one_line_of_error(capsys, "query", run, "chair")
    assert "map.ply has no labels; run SLAM again" in line
    assert "has no labels" in one_line_of_error(
        capsys, "export", run, "--to", run / "a.ply", "--keep", "chair"
    )
    tree = Taxonomy({"a": {"b": ["c", "d"]}, "e": ["f"]}, name="other")
    tree.save(room_run / "taxonomy.yaml")
    line = one_line_of_error(capsys, "query", room_run, "c")
    assert "taxonomy 'other' has 3" in line
    assert str(room_run) in line
    (room_run / "taxonomy.yaml").unlink()
    assert "has no taxonomy.yaml" in one_line_of_error(capsys, "query", room_run, "chair")


def test_export_keeps_or_drops_classes_and_their_labels(finished, tmp_path):
    before = read_splats(finished / "map.ply").labels.label
    kept, dropped, all_of_it = (tmp_path / f"{name}.ply" for name in ("kept", "dropped", "all"))
    done = semsplat("export", finished, "--to", kept, "--keep", "furnishings", "--drop", "table")
    assert done.returncode == 0, done.stderr
    labels = read_splats(kept).labels
    assert set(labels.label) == {IDS["chair"]}
    assert len(labels) == (before == IDS["chair"]).sum()
    words = ["--drop", "sofa", "building", "void"]
    assert main(["export", str(finished), "--to", str(dropped), *words]) == 0
    assert set(read_splats(dropped).labels.label) == {IDS["chair"], IDS["table"]}
    assert main(["export", str(finished), "--to", str(all_of_it)]) == 0
    np.testing.assert_array_equal(read_splats(all_of_it).labels.label, before)


def test_export_makes_meshes_and_points_of_a_part(finished, tmp_path):
    mesh, points = tmp_path / "rest.mesh.ply", tmp_path / "chairs.pcd"
    words = ["--drop", "furnishings", "--every", "1", "--voxel-m", "0.03"]
    assert main(["export", str(finished), "--to", str(mesh), *words]) == 0
    vertices_m = in_room(np.asarray(open3d().io.read_triangle_mesh(str(mesh)).vertices))
    middle = ((vertices_m > (0.2, 0.2, 0.15)) & (vertices_m < (3.8, 2.8, 2.3))).all(axis=1)
    assert len(vertices_m) > 1000
    assert not middle.any()
    assert main(["export", str(finished), "--to", str(points), "--keep", "chair"]) == 0
    assert len(open3d().io.read_point_cloud(str(points)).points) == 936


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--keep", "chiar"], "did you mean chair"),
        (["--drop", "chiar"], "did you mean chair"),
        (["--keep", "sofa"], "contains no 'sofa'"),
        (["--drop", "large items"], "exclude all Gaussians"),
    ],
)
def test_bad_parts_are_reported_in_one_line(finished, tmp_path, capsys, words, said):
    line = one_line_of_error(capsys, "export", finished, "--to", tmp_path / "a.ply", *words)
    assert said in line
    assert list(tmp_path.iterdir()) == []


def test_a_picture_highlights_what_was_found(finished, tmp_path):
    file = tmp_path / "chairs.png"
    assert main(["query", str(finished), "chair", "--picture", str(file)]) == 0
    image = cv2.imread(str(file)).astype(int)
    blue, red = image[..., 0], image[..., 2]
    assert (red - blue > 60).mean() > 0.005  # the chairs and their outline
    assert (np.ptp(image, axis=2) < 12).mean() > 0.3  # the rest is grey


@pytest.mark.parametrize(
    ("words", "named"),
    [(["chair", "--picture", "chairs.jpg"], "chairs.jpg"), (["--picture", "all.png"], "--picture")],
)
def test_pictures_that_cannot_be_made_are_errors(capsys, finished, words, named):
    assert named in one_line_of_error(capsys, "query", finished, *words)
