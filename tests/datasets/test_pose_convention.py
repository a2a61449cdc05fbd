"""Given poses in another convention are found by depth and colour, and converted."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from moving_room import pose, write_recording

from toolkit.base.errors import DatasetError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.options import validated
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.checks import check_recording
from toolkit.datasets.pose_convention import judge_convention
from toolkit.datasets.registry import describe
from toolkit.datasets.samples import SmallFrames
from toolkit.io import images
from toolkit.io.trajectories import read_tum, write_tum
from toolkit.runs.execution import run
from toolkit.runs.maps.finished import load_run
from toolkit.runs.recordings import open_recording
from toolkit.runs.settings import RunSettings

FRAMES, FPS = 14, 10.0
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
UNITY = np.diag([1.0, -1.0, 1.0, 1.0])
ROBOT = np.eye(4)
ROBOT[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def scaled(T, factor):
    moved = np.array(T)
    moved[:3, 3] *= factor
    return moved


def scalar_first(T):
    """The pose whose quaternion is written as w x y z and read as x y z w."""
    x, y, z, w = se3.quaternion_xyzw(T[:3, :3])
    R = se3.rotation_from_quaternion_xyzw(np.array([w, x, y, z]))
    return se3.from_rotation_translation(R, T[:3, 3])


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A folder of a shaking camera in a box room, with its true poses."""
    return write_recording(tmp_path_factory.mktemp("poses") / "box", np.arange(FRAMES) / FPS)


def small(recording):
    return SmallFrames(RecordedDataset(recording))


def judged(folder, changed):
    """The judgement of the recording with every pose changed."""
    recording = describe("folder", folder)
    truth = recording.ground_truth
    poses = np.array([changed(T) for T in truth.T_world_camera])
    given = Trajectory(truth.timestamps_s, poses)
    return judge_convention(small(replace(recording, ground_truth=given))), given


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (lambda T: T @ OPENGL, "y up, z backward (OpenGL"),
        (se3.inverse, "from world to camera"),
        (lambda T: se3.inverse(T @ OPENGL), "inverted) and the axes of the cameras are x right"),
        (lambda T: UNITY @ T @ UNITY, "left-handed, as in Unity"),
        (lambda T: T @ ROBOT.T, "x forward, y left, z up"),
        (lambda T: scaled(T, 1e3), "in millimetres"),
        (scalar_first, "the order of the quaternions is w x y z instead of x y z w"),
        (lambda T: scalar_first(T @ OPENGL), "w x y z instead of x y z w and the axes of the"),
        (lambda T: scaled(T @ OPENGL, 1e2), "(OpenGL, Blender, ARKit) and positions are in centim"),
        (lambda T: scaled(T, 0.2), "in units of 5"),
    ],
    ids=[
        "opengl",
        "inverse",
        "both",
        "unity",
        "robot",
        "mm",
        "wxyz",
        "wxyz opengl",
        "opengl cm",
        "unscaled",
    ],
)
def test_conventions_are_found_and_converted(recording, changed, words):
    report, given = judged(recording, changed)
    assert words in report.verdict()
    converted = report.found.applied(given)
    truth = describe("folder", recording).ground_truth
    for number in (4, 9):
        motions = [
            se3.inverse(t.T_world_camera[0]) @ t.T_world_camera[number] for t in (converted, truth)
        ]
        np.testing.assert_allclose(*motions, atol=0.02)


def test_right_poses_are_not_doubted(recording):
    report, _ = judged(recording, lambda T: T)
    assert report.found.is_ours
    assert report.verdict() is None
    world = se3.exp(np.array([3.0, -2.0, 5.0, 0.4, -1.0, 2.0]))
    assert judged(recording, lambda T: world @ T)[0].verdict() is None


def test_poses_of_other_images_are_not_explained(recording):
    poses = iter(np.random.default_rng(0).permutation(FRAMES))
    report, _ = judged(recording, lambda T: pose(5.0 + 0.4 * next(poses)))
    assert report.found is None
    assert "whatever their axes" in report.verdict()


def test_parts_that_a_camera_leaves_behind_are_no_contradiction(tmp_path, recording):
    # A corridor without texture looks the same from everywhere in it.
    columns, rows = np.meshgrid(np.arange(96) - 47.5, np.arange(72) - 35.5)
    ratio = np.stack([np.abs(columns) / 90.0 / 1.0, np.abs(rows) / 90.0 / 1.2])
    depth_m = 1.0 / ratio.max(axis=0)
    depth_m[depth_m > 12.0] = 0.0
    rgb = np.repeat(0.3 + 0.4 * (ratio[0] > ratio[1])[..., None], 3, axis=2).astype(np.float32)
    for kind in ("rgb", "depth"):
        (tmp_path / kind).mkdir()
    for n in range(FRAMES):
        images.write_rgb(tmp_path / "rgb" / f"{n:04d}.png", rgb)
        images.write_png(tmp_path / "depth" / f"{n:04d}.png", (5000 * depth_m).astype(np.uint16))
    (tmp_path / "intrinsics.yaml").write_text((recording / "intrinsics.yaml").read_text())
    poses = np.array([se3.exp(np.array([0, 0, 0.1 * n, 0, 0, 0])) for n in range(FRAMES)])
    write_tum(tmp_path / "trajectory.txt", Trajectory(np.arange(FRAMES) / FPS, poses))
    report = judge_convention(small(describe("folder", tmp_path)))
    assert report is None or report.verdict() is None


@pytest.fixture
def opengl_recording(recording, tmp_path) -> Path:
    """The recording with the camera axes of OpenGL."""
    folder = tmp_path / "opengl"
    folder.mkdir()
    for name in ("rgb", "depth", "intrinsics.yaml"):
        (folder / name).symlink_to(recording / name)
    truth = read_tum(recording / "trajectory.txt")
    given = Trajectory(truth.timestamps_s, truth.T_world_camera @ OPENGL)
    write_tum(folder / "trajectory.txt", given)
    return folder


def settings_for(folder: Path, **dataset: str) -> RunSettings:
    content = {"dataset": {"kind": "folder", "path": str(folder), **dataset}, "poses": "given"}
    return validated(RunSettings, content)


def test_check_data_and_run_report_it(opengl_recording, tmp_path):
    (fault,) = check_recording(describe("folder", opengl_recording)).faults
    assert "OpenGL" in fault
    out = tmp_path / "run"
    with pytest.raises(DatasetError, match=r"OpenGL.*pose-convention correct"):
        run(settings_for(opengl_recording), out)
    assert not out.exists()


def test_the_recording_is_opened_with_converted_poses(opengl_recording, recording):
    settings = settings_for(opengl_recording, pose_convention="correct")
    dataset = open_recording(settings, opengl_recording)
    truth = read_tum(recording / "trajectory.txt")
    np.testing.assert_allclose(dataset.ground_truth.T_world_camera, truth.T_world_camera, atol=1e-5)


def test_a_run_reports_what_check_data_finds(opengl_recording, tmp_path, caplog):
    out = tmp_path / "run"
    with caplog.at_level(logging.WARNING, "toolkit"):
        run(settings_for(opengl_recording, pose_convention="trust"), out)
    assert "contradict depth and colour" in caplog.text
    assert "contradict depth and colour" in (out / "report.html").read_text()
    assert "contradict depth and colour" in (out / "log.txt").read_text()


def test_far_poses_become_relative_to_an_origin(recording, tmp_path, caplog):
    """With the coordinates of UTM, given poses give the same map as near zero."""
    folder, utm = tmp_path / "utm", np.array([388096.0, 3948996.0, 57.0])
    folder.mkdir()
    for name in ("rgb", "depth", "intrinsics.yaml"):
        (folder / name).symlink_to(recording / name)
    near = read_tum(recording / "trajectory.txt")
    write_tum(folder / "trajectory.txt", near.transformed(se3.exp(np.array([*utm, 0, 0, 0]))))
    psnr_db = []
    for place in (folder, recording):
        out = tmp_path / f"run-{place.name}"
        with caplog.at_level(logging.INFO, "toolkit"):
            run(settings_for(place), out)
        images = json.loads((out / "metrics.json").read_text())["images"]
        psnr_db.append(images["mapped"]["psnr_db"])
    assert psnr_db[0] == pytest.approx(psnr_db[1], abs=0.2)
    finished = load_run(tmp_path / "run-utm")
    np.testing.assert_array_equal(finished.origin_m, np.floor(utm + near.positions_m[0]))
    assert (tmp_path / "run-utm/log.txt").read_text().count("relative to the origin 38809") == 1
    dataset = finished.open_dataset()
    np.testing.assert_array_equal(dataset.origin_m, finished.origin_m)
    assert np.abs(finished.trajectory.positions_m).max() < 2.0
