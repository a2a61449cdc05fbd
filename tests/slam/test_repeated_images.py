"""Images that were sent or stored twice: they tell nothing new, and the camera may have moved."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from slam_room import blind_frames, fed, fingerprint, first_steps, new_slam

from toolkit.base.geometry import se3

FROZEN = range(6, 10)


@pytest.fixture(scope="module")
def frames():
    """The images of frame 5 in place of the next four."""
    frames = first_steps(13).frames
    for index in FROZEN:
        own = frames[index]
        frames[index] = replace(frames[5], index=own.index, timestamp_s=own.timestamp_s)
    return frames


@pytest.fixture(scope="module")
def run(frames):
    slam = new_slam()
    return slam, fed(slam, frames)


def test_they_keep_the_last_pose(run):
    _, results = run
    for index in FROZEN:
        assert not results[index].lost and not results[index].keyframe
        np.testing.assert_allclose(results[index].T_map_camera, results[5].T_map_camera, atol=1e-12)
        assert results[index].tracking.renders == 0


def test_they_are_doubtful_once_the_camera_may_have_moved(run, frames):
    slam, results = run
    step = se3.inverse(results[4].T_map_camera) @ results[5].T_map_camera
    steps = 0.035 / float(se3.rotation_angle_rad(step[:3, :3]))
    assert 1.0 < steps < 4.0
    doubtful = [results[index].doubtful for index in FROZEN]
    assert doubtful == [number > steps for number in range(1, 5)]
    assert "its images are those of frame 5" in results[FROZEN[-1]].reason
    assert set(slam.result().doubtful_frames) == {i for i in FROZEN if results[i].doubtful}
    path = slam.camera_path.measured_poses(slam.atlas)
    first, last = (np.trace(path[index].view_covariance) for index in (5, FROZEN[-1]))
    assert last > first + 0.035**2


def test_the_frame_after_them_is_tracked(run, frames):
    _, results = run
    truth = first_steps(13).truth.T_world_camera
    for index in range(FROZEN[-1] + 1, 13):
        assert not results[index].lost and not results[index].doubtful
        off = se3.inverse(truth[index]) @ results[index].T_map_camera
        assert np.linalg.norm(off[:3, 3]) < 0.01


def test_black_frames_stay_lost(frames):
    slam = new_slam()
    results = fed(slam, [*frames[:4], *blind_frames(frames[4:6]), frames[10]])
    assert [result.lost for result in results[4:6]] == [True, True]


def test_a_resumed_run_ends_the_same(run, frames):
    begun, resumed = new_slam(), new_slam()
    fed(begun, frames[:8])
    arrays, values = begun.state()
    resumed.restore(arrays, json.loads(json.dumps(values)))
    fed(resumed, frames[8:])
    assert fingerprint(resumed) == fingerprint(run[0])
