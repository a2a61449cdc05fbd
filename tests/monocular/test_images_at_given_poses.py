"""Maps from colour images with given poses: depth is estimated from them alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from moving_camera import film, walk

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.options import validated
from toolkit.depth.monocular.given import motion_of_given_poses
from toolkit.io import images
from toolkit.io.trajectories import write_tum
from toolkit.runs.execution import run
from toolkit.runs.settings import RunSettings

FRAMES = 12
TIMES_S = np.arange(FRAMES) / 30.0


@pytest.fixture(scope="module")
def views():
    return film(walk(FRAMES))


def test_depth_ranges_follow_from_given_poses(views):
    given = Trajectory(TIMES_S, walk(FRAMES))
    motion = motion_of_given_poses(views, views[0].camera, given, metric=True)
    assert len(motion.views) >= FRAMES - 1
    assert motion.metric_scale is not None and motion.metric_scale.factor == 1.0
    np.testing.assert_array_equal(motion.trajectory.T_world_camera, given.T_world_camera)
    for view in motion.views:
        depth_m = views[view.frame].depth_m
        low, high = np.percentile(depth_m[depth_m > 0], [1, 99])
        assert 0.7 * low < view.near < view.far < 1.4 * high


def test_frames_without_a_pose_are_counted(views):
    given = Trajectory(TIMES_S[2:], walk(FRAMES)[2:])
    motion = motion_of_given_poses(views, views[0].camera, given, metric=False)
    assert motion.frames == FRAMES and len(motion.trajectory) == FRAMES - 2
    assert motion.without_pose == {"no pose is given": 2}
    assert motion.metric_scale is None


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (lambda poses: poses @ np.diag([1.0, -1.0, -1.0, 1.0]), "OpenGL"),
        (lambda poses: np.array([se3.inverse(T) for T in poses]), "from world to camera"),
    ],
    ids=["opengl", "inverse"],
)
def test_poses_that_contradict_the_images_are_refused(views, changed, words):
    given = Trajectory(TIMES_S, changed(walk(FRAMES)))
    with pytest.raises(DatasetError, match=words):
        motion_of_given_poses(views, views[0].camera, given, metric=True)


def test_a_camera_that_does_not_move_has_no_depth(views):
    still = Trajectory(TIMES_S, np.repeat(np.eye(4)[None], FRAMES, axis=0))
    with pytest.raises(DatasetError, match="depth cannot be estimated with the given poses"):
        motion_of_given_poses([views[0]] * FRAMES, views[0].camera, still, metric=True)


@pytest.fixture
def recording(views, tmp_path) -> Path:
    """Every third image, far apart, with its pose."""
    folder = tmp_path / "views"
    (folder / "rgb").mkdir(parents=True)
    for number, frame in enumerate(views[::2]):
        images.write_rgb(folder / f"rgb/{number:03d}.png", frame.rgb)
    camera = views[0].camera
    names = ("fx", "fy", "cx", "cy", "width", "height")
    values = {name: getattr(camera, name) for name in names} | {"fps": 30.0}
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(values))
    poses = walk(FRAMES)[::2]
    write_tum(folder / "trajectory.txt", Trajectory(TIMES_S[: len(poses)], poses))
    return folder


def test_a_run_maps_images_at_their_given_poses(recording, tmp_path):
    content = {
        "dataset": {"kind": "folder", "path": str(recording)},
        "poses": "given",
        "depth": "none",
        "mapping": {"final_iterations": 2},
    }
    run(validated(RunSettings, content), tmp_path / "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["frames"]["lost"] == 0
    assert metrics["trajectory"]["ate_rmse_cm"] is None
    assert metrics["images"]["mapped"]["psnr_db"] > 22.0
    assert json.loads((tmp_path / "run" / "frames.json").read_text())["metric"] is True


def test_given_poses_must_exist(recording, tmp_path):
    (recording / "trajectory.txt").unlink()
    place = {"kind": "folder", "path": str(recording)}
    settings = validated(RunSettings, {"dataset": place, "poses": "given", "depth": "none"})
    with pytest.raises((DatasetError, SettingsError), match="has no poses"):
        run(settings, tmp_path / "run")
    assert not (tmp_path / "run").exists()
