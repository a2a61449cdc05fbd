"""export --format: files that other tools read, checked with readers that are not ours."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from box_scene import frames_content, poses
from labelled_room import IDS, LENGTH_M, T_MAP_ROOM, WIDTH_M
from test_finished_run_programs import one_line_of_error

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.options import DatasetOptions
from toolkit.io.colmap import read_images
from toolkit.io.images import read_rgb
from toolkit.io.splats import read_splats, write_splat_ply
from toolkit.io.trajectories import read_tum
from toolkit.runs.folder import MapPart, RunFolder
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.semantics.colour_names import COLOUR_NAMES
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.tools.cli.main import main
from toolkit.tools.cli.map_programs import ExportOptions
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.reading import read_scene

UTM = np.array([388096.0, 3948996.0, 57.0])
MESH = ["--every", "1", "--voxel-m", "0.04"]


def export(run: Path, to: Path, *words: str) -> Path:
    assert main(["export", str(run), "--to", str(to), *words]) == 0
    return to


@pytest.fixture(scope="module")
def dots_run(tmp_path_factory) -> Path:
    """A run over nine bright dots far apart in the dark, without its dataset."""
    a, b = (axis.ravel() for axis in np.meshgrid([-0.6, 0.0, 0.6], [-0.45, 0.0, 0.45]))
    means = np.stack([a, b, 2.0 + 0.2 * np.arange(9) / 9], axis=1)
    gaussians = GaussianCloud.from_values(
        means=torch.tensor(means, dtype=torch.float32),
        radii_m=torch.full((9,), 0.05),
        opacities=torch.full((9,), 0.9),
        colours=torch.ones((9, 3)),
    )
    settings = RunSettings(dataset=DatasetOptions(kind="folder", path=Path("/gone")))
    folder = RunFolder.create(tmp_path_factory.mktemp("dots") / "run", dump_settings(settings))
    T_map_camera = poses(2, seed=3)
    folder.write_trajectory(Trajectory(np.arange(2) / 30.0, T_map_camera))
    folder.write_map([MapPart(gaussians)])
    folder.write_json(folder.frames, frames_content(2, [0]))
    return folder.path


@pytest.fixture(scope="module")
def far_run(dots_run, tmp_path_factory) -> Path:
    """The same run with an origin in UTM."""
    run = tmp_path_factory.mktemp("far") / "run"
    shutil.copytree(dots_run, run)
    content = json.loads((run / "frames.json").read_text())
    (run / "frames.json").write_text(json.dumps(content | {"origin_m": UTM.tolist()}))
    return run


def test_exports_contain_the_origin_of_far_poses(far_run, dots_run, tmp_path, caplog):
    """Positions keep tenths of a millimetre, 4000 km from zero."""
    trimesh = pytest.importorskip("trimesh")
    near = read_splats(dots_run / "map.ply").means
    for name, words in (("a.ply", ["labelled-points"]), ("b.ply", ["points"])):
        file = export(far_run, tmp_path / name, "--format", *words)
        np.testing.assert_allclose(trimesh.load(file).vertices - UTM, near, atol=1e-4)
    poses_m = read_tum(export(far_run, tmp_path / "poses.txt")).positions_m
    here_m = read_tum(dots_run / "trajectory.txt").positions_m
    np.testing.assert_allclose(poses_m - UTM, here_m, atol=1e-6)
    words = ["--format", "colmap-text", "--images", "render", "--every", "1"]
    model = export(far_run, tmp_path / "model", *words) / "sparse/0"
    images = read_images(model / "images.txt")
    centres_m = [image.T_world_camera[:3, 3] for image in images]
    np.testing.assert_allclose(np.array(centres_m) - UTM, here_m, atol=1e-6)
    assert not caplog.records
    splats = export(far_run, tmp_path / "splats.ply")
    assert b"comment origin_m 388096.000 3948996.000 57.000\n" in splats.read_bytes()
    np.testing.assert_array_equal(read_splats(splats).means, near)
    assert "add the origin_m 388096.000" in caplog.text
    export(far_run, tmp_path / "points.pcd")
    assert "points.pcd has single precision" in caplog.text


def test_gltf_and_las_contain_the_origin(labelled_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(labelled_run, run)
    content = json.loads((run / "frames.json").read_text())
    (run / "frames.json").write_text(json.dumps(content | {"origin_m": UTM.tolist()}))
    trees = [
        json.loads(export(r, tmp_path / f"{k}.gltf", *MESH).read_text())["nodes"][0]
        for k, r in enumerate((run, labelled_run))
    ]
    far, near = (np.array(tree["matrix"]).reshape(4, 4).T for tree in trees)
    np.testing.assert_allclose(far[:3, 3] - near[:3, 3], near[:3, :3] @ UTM, rtol=1e-12)
    laspy = pytest.importorskip("laspy")
    las = laspy.read(export(run, tmp_path / "room.las"))
    means = read_splats(labelled_run / "map.ply").means
    np.testing.assert_allclose(las.xyz - UTM, means, atol=1.1e-4)


def test_labels_beside_a_sog_are_those_of_the_selected_gaussians(labelled_run, tmp_path):
    path = export(labelled_run, tmp_path / "chairs.sog", "--keep", "chair")
    scene = read_scene(path, ShownContent())
    chairs = read_splats(labelled_run / "map.ply").labels.label == IDS["chair"]
    assert scene.total == chairs.sum()
    (node,) = np.unique(scene.splats.levels[:, -1])
    assert scene.tree.nodes[node].path[-1] == "chair"


def centroids(rgb: np.ndarray) -> np.ndarray:
    """Centres [9, 2] of the dots in an image, in pixels with centres at integers."""
    grey = rgb.mean(axis=2)
    count, marks = cv2.connectedComponents((grey > 0.05).astype(np.uint8))
    assert count == 10, "the dots do not lie apart in the image"
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    weights = [grey * (marks == k) for k in range(1, count)]
    return np.array([[(w * columns).sum(), (w * rows).sum()] / w.sum() for w in weights])


def nearest_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1)


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_colmap_projects_points_where_we_render_them(dots_run, tmp_path, kind):
    pycolmap = pytest.importorskip("pycolmap")
    words = ["--format", f"colmap-{kind}", "--images", "render", "--every", "1"]
    folder = export(dots_run, tmp_path / "model", *words)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert (model.num_images(), model.num_points3D()) == (2, 9)
    assert {p.suffix for p in (folder / "sparse/0").iterdir()} == {
        ".txt" if kind == "text" else ".bin"
    }
    points = np.array([point.xyz for point in model.points3D.values()])
    for image in model.images.values():
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        camera = model.cameras[image.camera_id]
        # COLMAP's pixel centres are at 0.5.
        projected = np.array([camera.img_from_cam(pose * p) for p in points]) - 0.5
        rendered = centroids(read_rgb(folder / "images" / image.name))
        assert nearest_distance(rendered, projected).max() < 0.15


def test_nerfstudio_cameras_look_along_their_negative_z(dots_run, tmp_path):
    words = ["--format", "nerfstudio", "--images", "render", "--every", "1"]
    folder = export(dots_run, tmp_path / "ns", *words)
    content = json.loads((folder / "transforms.json").read_text())
    trimesh = pytest.importorskip("trimesh")
    points = np.asarray(trimesh.load(folder / content["ply_file_path"]).vertices)
    assert len(content["frames"]) == 2
    for frame in content["frames"]:
        T_camera_world = np.linalg.inv(np.array(frame["transform_matrix"]))
        x, y, z = (T_camera_world @ np.column_stack([points, np.ones(9)]).T)[:3]
        assert (z < 0).all()
        u = content["fl_x"] * x / -z + content["cx"] - 0.5
        v = content["fl_y"] * y / z + content["cy"] - 0.5
        rendered = centroids(read_rgb(folder / frame["file_path"]))
        assert nearest_distance(rendered, np.stack([u, v], axis=1)).max() < 0.15


def test_images_are_copied_or_referenced(labelled_run, tmp_path, capsys):
    words = ["--format", "colmap-text", "--every", "1"]
    copied = export(labelled_run, tmp_path / "copied", *words)
    referenced = export(labelled_run, tmp_path / "referenced", *words, "--images", "reference")
    assert not (referenced / "images").exists()
    lines = (referenced / "sparse/0/images.txt").read_text().splitlines()
    names = [line.split()[9] for line in lines if line.endswith((".png", ".jpg"))]
    recording = labelled_run.parent / "recording"
    files = sorted((copied / "images").iterdir())
    assert len(names) == len(files) == 3
    for name, file in zip(names, files, strict=True):
        np.testing.assert_allclose(read_rgb(recording / name), read_rgb(file), atol=1 / 255)


def test_gltf_has_a_node_per_class_and_stands_upright(labelled_run, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.load(export(labelled_run, tmp_path / "room.glb", *MESH))
    assert {"floor", "wall", "table", "chair"} <= set(scene.geometry)
    # The floor is horizontal, and the rest is above it: glTF has y up.
    by_name = {scene.graph[n][1]: n for n in scene.graph.nodes_geometry}

    def vertices(name: str) -> np.ndarray:
        T, geometry = scene.graph[by_name[name]]
        return trimesh.transform_points(scene.geometry[geometry].vertices, T)

    floor, table = vertices("floor"), vertices("table")
    assert np.ptp(np.percentile(floor[:, 1], [10, 80])) < 0.1
    height_m = np.percentile(table[:, 1], 98) - np.median(floor[:, 1])
    assert height_m == pytest.approx(0.75, abs=0.05)
    # Colours are linear in the file.
    colours = scene.geometry["table"].visual.vertex_attributes["color"][:, :3] / 65535.0
    splats = read_splats(labelled_run / "map.ply")
    srgb = splats.colours[splats.labels.label == IDS["table"]][0]
    np.testing.assert_allclose(np.median(colours, axis=0), srgb**2.2, atol=0.06)


def test_the_embedded_gltf_is_the_same_as_the_binary(labelled_run, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    words = [*MESH, "--keep", "table"]
    sizes = []
    for name in ("a.glb", "a.gltf"):
        scene = trimesh.load(export(labelled_run, tmp_path / name, *words))
        sizes.append(sum(len(g.faces) for g in scene.geometry.values()))
    assert sizes[0] == sizes[1] > 100


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_holds_classes_and_their_names(labelled_run, tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    las = laspy.read(export(labelled_run, tmp_path / f"room{suffix}"))
    splats = read_splats(labelled_run / "map.ply")
    np.testing.assert_array_equal(las["label"], splats.labels.label)
    np.testing.assert_array_equal(las.classification, 63 + splats.labels.label)
    np.testing.assert_allclose(las["confidence"], splats.labels.confidence, atol=1e-6)
    np.testing.assert_allclose(las.xyz, splats.means, atol=1e-4)
    np.testing.assert_allclose(np.asarray(las.red) / 65535, splats.colours[:, 0], atol=2e-3)
    (names,) = (v for v in las.header.vlrs if v.user_id == "semsplat")
    assert json.loads(names.record_data)[str(IDS["chair"])] == "chair"


def test_a_labelled_ply_holds_classes_and_their_names(labelled_run, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    file = export(labelled_run, tmp_path / "room.ply", "--format", "labelled-points")
    cloud = trimesh.load(file)
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    splats = read_splats(labelled_run / "map.ply")
    np.testing.assert_array_equal(data["label"], splats.labels.label)
    np.testing.assert_allclose(cloud.vertices, splats.means, atol=1e-6)
    assert f"comment class {IDS['table']} table".encode() in file.read_bytes()


def test_the_occupancy_grid_is_that_of_the_room(labelled_run, tmp_path):
    file = export(labelled_run, tmp_path / "room.yaml")
    content = yaml.safe_load(file.read_text())
    image = cv2.imread(str(tmp_path / content["image"]), cv2.IMREAD_UNCHANGED)
    probability = (255 - image.astype(float)) / 255
    occupied = probability > content["occupied_thresh"]
    free = probability < content["free_thresh"]
    # As map_server: the origin is the outer corner of the last row's first cell.
    T_grid_room = np.array(content["T_grid_map"]) @ T_MAP_ROOM

    def cell(x: float, y: float) -> tuple[int, int]:
        place = se3.transform_points(T_grid_room, np.array([[x, y, 0.0]]))[0, :2]
        column, up = ((place - content["origin"][:2]) // content["resolution"]).astype(int)
        return image.shape[0] - 1 - up, column

    assert free[cell(3.5, 2.5)] and free[cell(0.5, 0.5)]
    assert occupied[cell(2.1, 1.4)] and occupied[cell(0.0, 1.5)] and occupied[cell(2.0, WIDTH_M)]
    assert not free[cell(LENGTH_M + 0.15, 1.0)] and not occupied[cell(LENGTH_M + 0.15, 1.0)]
    area_m2 = free.sum() * content["resolution"] ** 2
    assert 8.0 < area_m2 < LENGTH_M * WIDTH_M
    without = export(labelled_run, tmp_path / "empty.yaml", "--drop", "furnishings")
    image = cv2.imread(str(without.with_suffix(".pgm")), cv2.IMREAD_UNCHANGED)
    assert image[cell(2.1, 1.4)] == 254


def test_the_floor_is_found_without_labels(labelled_run, tmp_path):
    bare = shutil.copytree(labelled_run, tmp_path / "bare")
    write_splat_ply(bare / "map.ply", read_splats(bare / "map.ply"))
    files = [export(r, tmp_path / f"{r.parent.name}.yaml") for r in (labelled_run, bare)]
    a, b = (np.array(yaml.safe_load(file.read_text())["T_grid_map"]) for file in files)
    np.testing.assert_allclose(a[2], b[2], atol=0.01)


def test_the_scene_graph_is_read_by_networkx(labelled_run, tmp_path):
    networkx = pytest.importorskip("networkx")
    file = export(labelled_run, tmp_path / "graph.json", "--format", "scene-graph")
    graph = networkx.node_link_graph(json.loads(file.read_text()), edges="edges")
    names = networkx.get_node_attributes(graph, "name")
    relations = {(names[a], r, names[b]) for a, b, r in graph.edges(data="relation")}
    assert ("table", "on", "floor") in relations
    assert ("chair", "on", "floor") in relations
    assert {r for a, r, b in relations if {a, b} == {"chair", "table"}} == {"next to", "facing"}
    assert {r for a, r, _ in relations if a == "floor"} == {"part of"}
    (table,) = (n for n in graph if names[n] == "table")
    assert graph.nodes[table]["box"]["size_m"] == pytest.approx([1.2, 0.8, 0.75], abs=0.01)


def test_the_scene_graph_has_the_room_and_what_is_known_of_objects(labelled_run, tmp_path):
    file = export(labelled_run, tmp_path / "graph.json", "--format", "scene-graph")
    content = json.loads(file.read_text())
    (room,) = (node for node in content["nodes"] if node["kind"] == "room")
    assert room["area_m2"] == pytest.approx(LENGTH_M * WIDTH_M, rel=0.1) and not room["doors"]
    kinds = {node["id"]: node["kind"] for node in content["nodes"]}
    into_room = {
        (kinds[edge["source"]], edge["relation"])
        for edge in content["edges"]
        if edge["target"] == room["id"]
    }
    assert into_room == {("object", "in"), ("structure", "part of")}
    (table,) = (node for node in content["nodes"] if node["name"] == "table")
    assert table["rooms"] == [1]
    assert (table["first_seen"], table["last_seen"], table["keyframes"]) == (0, 0, 1)
    assert table["colour"] in COLOUR_NAMES
    facing = {
        edge["target"]
        for edge in content["edges"]
        if edge["relation"] == "facing" and edge["source"] != table["id"]
    }
    assert facing == {table["id"]}  # both chairs


def test_graphml_and_json_ld_contain_the_same_graph(labelled_run, tmp_path):
    networkx = pytest.importorskip("networkx")
    json_file = export(labelled_run, tmp_path / "graph.json", "--format", "scene-graph")
    content = json.loads(json_file.read_text())
    expected = {(str(e["source"]), e["relation"], str(e["target"])) for e in content["edges"]}

    graph = networkx.read_graphml(export(labelled_run, tmp_path / "graph.graphml"))
    relations = {(a, r, b) for a, b, r in graph.edges(data="relation")}
    assert relations == expected
    for node in content["nodes"]:
        values = graph.nodes[str(node["id"])]
        assert values["name"] == node["name"]
        if "box" in node:
            assert json.loads(values["box"]) == node["box"]
            assert values["confidence"] == node["confidence"]

    linked = json.loads(export(labelled_run, tmp_path / "graph.jsonld").read_text())
    terms = linked["@context"]
    names = {"on": "on", "in": "in", "nextTo": "next to", "partOf": "part of", "facing": "facing"}
    found = {
        (node["@id"].removeprefix("node/"), names[key], target.removeprefix("node/"))
        for node in linked["nodes"]
        for key in node.keys() & names.keys()
        for target in node[key]
    }
    assert found == expected
    assert all(terms[key]["@type"] == "@id" for key in names if key in terms)


def test_the_floor_plan_shows_the_classes_in_place(labelled_run, tmp_path):
    plan = read_rgb(export(labelled_run, tmp_path / "plan.png", "--format", "floor-plan"))
    assert plan.shape[0] > 300
    # More wide than high by the room's own sides, and a legend beside it.
    assert len(np.unique(plan.reshape(-1, 3).round(2), axis=0)) > 4


def test_the_floor_plan_shows_rooms_and_a_path(labelled_run, tmp_path, capsys):
    content = json.loads(
        export(labelled_run, tmp_path / "graph.json", "--format", "scene-graph").read_text()
    )
    ids = [str(n["id"]) for n in content["nodes"] if n["name"] == "chair"]
    words = ["--format", "floor-plan", "--plan.width-m", "0.2"]
    bare = read_rgb(export(labelled_run, tmp_path / "bare.png", *words))
    plan = read_rgb(
        export(labelled_run, tmp_path / "plan.png", *words, "--plan.path", ids[0], ids[1])
    )
    assert "1 rooms, and a path of" in capsys.readouterr().out
    assert plan.shape == bare.shape
    drawn = np.abs(plan - bare).max(axis=2) > 0.05
    red = (plan[..., 0] > 0.7) & (plan[..., 1] < 0.3) & (plan[..., 2] < 0.3)
    assert 0.002 < drawn.mean() < 0.2 and (red & drawn).any()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--to", "OUT/a", "--format", "colmap"], "--format"),
        (["--to", "OUT/a.ply", "--format", "mesh", "--points"], "not both"),
        (["--to", "OUT/a.obj", "--format", "gltf"], ".glb or .gltf"),
        (["--to", "OUT/a.txt", "--format", "scene-graph"], ".json or .jsonld or .graphml"),
        (["--to", "RUN", "--format", "nerfstudio"], "not an empty folder"),
        (["--to", "OUT/no/a.glb"], "there is no folder"),
        (["--to", "/proc/model", "--format", "colmap-text"], "cannot write /proc/model"),
        (["--to", "OUT/a.yaml", "--grid.cell-m", "0"], "--grid.cell-m"),
        (["--to", "OUT/a.png", "--format", "floor-plan", "--plan.path", "0", "99"], "no object 99"),
        (["--to", "OUT/a.yaml", "--grid.min-height-m", "2"], "must be less than"),
        (["--to", "OUT/a.yaml", "--floor", "flor"], "did you mean floor"),
        (["--to", "OUT/a.json", "--format", "scene-graph", "--floor", "flor"], "did you mean"),
    ],
)
def test_bad_exports_are_reported_in_one_line(labelled_run, tmp_path, capsys, words, said):
    paths = {"OUT": str(tmp_path), "RUN": str(labelled_run)}
    for name, path in paths.items():
        words = [word.replace(name, path) for word in words]
    assert said in one_line_of_error(capsys, "export", labelled_run, *words)


def test_runs_without_labels_or_data_say_what_to_do(dots_run, tmp_path, capsys):
    line = one_line_of_error(
        capsys, "export", dots_run, "--to", tmp_path / "a.json", "--format", "scene-graph"
    )
    assert "has no labels" in line
    line = one_line_of_error(
        capsys, "export", dots_run, "--to", tmp_path / "a", "--format", "colmap-text"
    )
    assert "/gone" in line
    line = one_line_of_error(capsys, "export", dots_run, "--to", tmp_path / "a.yaml")
    assert "no floor was found" in line


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("map.ply", "splats"),
        ("map.mesh.ply", "mesh"),
        ("map.glb", "gltf"),
        ("map.splats.glb", "splats"),
        ("map.PCD", "points"),
        ("map.las", "labelled-points"),
        ("map.json", "scene-graph"),
        ("map.png", "floor-plan"),
        ("poses.tum", "trajectory"),
        ("map.other", "splats"),
    ],
)
def test_the_format_follows_from_the_name(name, kind):
    assert ExportOptions(run=Path("run"), to=Path(name)).kind == kind
