"""Rooms on disk: layout, reproducibility and invalid arguments."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from programs import run

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic_rooms import RoomSettings, SensorModel, make_room, tiny_room
from toolkit.datasets.synthetic_rooms.layouts import PLAIN_CLASSES
from toolkit.datasets.synthetic_rooms.unseen import _visible_fraction, poses_off_the_path
from toolkit.datasets.synthetic_rooms.writer import _stored
from toolkit.tools.cli.main import main as program

TINY = RoomSettings(frames=6, share=0.1, width=64, height=48, unseen=2)
LAUNCHER = Path(__file__).parents[2] / "data_tools" / "make_room.py"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = tmp_path_factory.mktemp("rooms") / "room"
    make_room(path, TINY)
    return path


def _bytes(path):
    return {file.relative_to(path): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_folder_has_replicas_layout(made):
    for folder, count in ((made, 6), (made / "unseen", 2)):
        for index in range(count):
            for name in (f"results/frame{index:06d}", f"results/depth{index:06d}",
                         f"labels/label{index:06d}"):  # fmt: skip
                assert cv2.imread(f"{folder / name}.png", -1).shape[:2] == (48, 64)
        assert np.loadtxt(folder / "traj.txt").shape == (count, 16)
        camera = json.loads((folder / "cam_params.json").read_text())["camera"]
        assert (camera["w"], camera["h"], camera["scale"]) == (64, 48, 6553.5)
        classes = json.loads((folder / "labels" / "classes.json").read_text())
        assert classes["void"] == 0
        assert classes["classes"]["93"] == "wall"


def test_dataset_reader_round_trip(made):
    dataset = open_dataset("synthetic", made)
    frames, truth = tiny_room(6, 64, 48)
    assert len(dataset) == 6
    # The tiny room covers 6/300 of the path, the written one a tenth; both start equally.
    read = dataset[0]
    assert np.abs(read.rgb - frames[0].rgb).max() < 0.6 / 255
    assert np.abs(read.depth_m - frames[0].depth_m).max() < 0.6 / 6553.5
    np.testing.assert_array_equal(read.labels, frames[0].labels)
    np.testing.assert_allclose(
        dataset.ground_truth.T_world_camera[0], truth.T_world_camera[0], atol=1e-8
    )


def test_depth_beyond_the_range_of_the_files_is_missing():
    np.testing.assert_array_equal(_stored(np.array([0.0, 9.99, 10.1])), [0, 65469, 0])


def test_mesh_agrees_with_depth(made):
    mesh = open3d().t.io.read_triangle_mesh(str(made / "mesh.ply"))
    casting = open3d().t.geometry.RaycastingScene()
    casting.add_triangles(mesh)
    frames, truth = tiny_room(3, 64, 48)
    T = truth.T_world_camera[2]
    points = frames[2].camera.unproject(frames[2].depth_m).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    distance = casting.compute_distance(points.astype(np.float32)).numpy()
    assert distance.max() < 1e-4


def test_output_is_reproducible_across_processes(made, tmp_path):
    out = tmp_path / "again"
    words = ("--frames", 6, "--share", 0.1, "--image-size", 64, 48, "--unseen", 2)
    run(LAUNCHER, "--out", out, *words).check_returncode()
    first, second = _bytes(made), _bytes(out)
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


def test_recreating_a_room_removes_old_files(made, tmp_path):
    make_room(tmp_path, RoomSettings(frames=3, share=0.1, width=32, height=24, unseen=1))
    make_room(tmp_path, RoomSettings(frames=2, share=0.1, width=32, height=24, unseen=0))
    assert len(list((tmp_path / "results").glob("*.png"))) == 4
    assert not list((tmp_path / "unseen" / "results").glob("*.png"))


def test_progress_wraps_every_frame(tmp_path):
    seen = []

    def watched(frames, total):
        for frame in frames:
            seen.append((frame.index, total))
            yield frame

    settings = RoomSettings(frames=3, share=0.1, width=32, height=24, unseen=1)
    make_room(tmp_path, settings, watched)
    assert seen == [(0, 3), (1, 3), (2, 3)]
    assert len(list((tmp_path / "results").glob("*.png"))) == 6


def test_folder_with_other_files_is_not_changed(tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(DatasetError, match="not empty and not a synthetic room"):
        make_room(tmp_path, TINY)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_path_of_a_file_raises(tmp_path):
    (tmp_path / "room").write_text("")
    with pytest.raises(DatasetError, match="is a file"):
        make_room(tmp_path / "room", TINY)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"layout": "castle"}, "layout must be one of"),
        ({"frames": 0}, "frames must be at least 1"),
        ({"share": 0.0}, "share must lie in"),
        ({"width": 4}, "at least 16x16"),
        ({"seed": -1}, "must not be negative"),
        ({"texture": "none"}, "texture must be one of normal, weak, plain"),
        ({"fov_deg": 5.0}, "fov_deg must lie in"),
        ({"classes": 19}, r"classes must lie in \[20, 500\], got 19"),
        ({"classes": 501}, r"classes must lie in \[20, 500\], got 501"),
        ({"classes": 30, "layout": "ring"}, "classes requires the layout 'room'"),
        ({"classes": 30, "sensor": SensorModel(reflections=True)}, "cannot be combined with real"),
    ],
)
def test_values_out_of_range_raise(values, message):
    with pytest.raises(SettingsError, match=message):
        RoomSettings(**values)


def test_program_reports_errors_in_one_line(tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    done = run(LAUNCHER, "--out", tmp_path)
    assert done.returncode != 0
    assert len(done.stderr.strip().splitlines()) == 1
    assert "give another folder" in done.stderr


def test_tiny_rooms_differ_by_seed_and_by_sensor():
    plain, truth = tiny_room(2, 48, 36)
    other, _ = tiny_room(2, 48, 36, seed=1)
    noisy, same = tiny_room(2, 48, 36, sensor=SensorModel())
    assert np.abs(plain[0].rgb - other[0].rgb).mean() > 0.05
    measured = noisy[1].depth_m > 0
    assert 0.001 < np.abs(plain[1].depth_m - noisy[1].depth_m)[measured].mean() < 0.05
    np.testing.assert_array_equal(truth.T_world_camera, same.T_world_camera)


def test_options_of_the_program_change_texture_and_field_of_view(made, tmp_path):
    small = ("--frames", "1", "--share", "0.1", "--image-size", "64", "48", "--unseen", "0")
    changes = {"narrow": ["--fov-deg", "30"]}
    changes |= {texture: ["--texture", texture] for texture in ("weak", "plain")}
    for name, options in changes.items():
        words = ["make-room", "--out", str(tmp_path / name), *small, *options]
        assert program(words) == 0
    normal = open_dataset("synthetic", made)
    weak, plain, narrow = (
        open_dataset("synthetic", tmp_path / name) for name in ("weak", "plain", "narrow")
    )
    # The same surfaces with less contrast; the median pixel lies within one.
    np.testing.assert_array_equal(weak[0].depth_m, normal[0].depth_m)
    detail = [np.median(np.abs(np.diff(room[0].rgb, n=2, axis=1))) for room in (weak, normal)]
    assert detail[0] < 0.6 * detail[1]
    assert np.abs(weak[0].rgb.mean((0, 1)) - normal[0].rgb.mean((0, 1))).max() < 0.05
    names = {name: number for number, name in normal.label_names.items()}
    shell = np.isin(normal[0].labels, [names[name] for name in PLAIN_CLASSES if name in names])
    assert shell.mean() > 0.2
    changes = [
        np.abs(np.diff(room[0].rgb, n=2, axis=1))[shell[:, 1:-1]] for room in (plain, normal)
    ]
    assert np.median(changes[0]) < 0.6 * np.median(changes[1])
    np.testing.assert_allclose(plain[0].rgb[~shell], normal[0].rgb[~shell], atol=0.1)
    # The middle of the same image.
    assert normal.camera.fx == pytest.approx(0.8 * 64)
    assert np.degrees(2 * np.arctan(32 / narrow.camera.fx)) == pytest.approx(30.0)
    middle = [room[0].depth_m[23:25, 31:33].mean() for room in (normal, narrow)]
    assert middle[0] == pytest.approx(middle[1], rel=0.05)
    spread = [np.ptp(room[0].rgb.mean((0, 2))) for room in (normal, narrow)]
    assert spread[0] != pytest.approx(spread[1], rel=0.01)


def test_unseen_views_are_off_the_path_and_show_known_surfaces(scene):
    camera = Camera(32.0, 32.0, 19.5, 14.5, 40, 30)
    path = tiny_room(40, 32, 24)[1].T_world_camera
    poses = poses_off_the_path(scene, camera, path, 3, np.random.default_rng(0))
    assert len(poses) == 3
    witnesses = [(T, scene.render_depth(camera, T)) for T in path]
    for T in poses:
        gap = np.linalg.norm(path[:, :3, 3] - T[:3, 3], axis=1).min()
        assert gap > 0.02
        assert scene.distance_m(T[None, :3, 3])[0] >= 0.4
        assert _visible_fraction(scene, camera, T, witnesses) > 0.95
    away = path[0].copy()
    away[:3, :3] = away[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    assert _visible_fraction(scene, camera, away, witnesses) < 0.5
