"""Sequences of a camera with a rolling shutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam_room import SlamRoom, blind_frames, fed, fingerprint, new_semantic_slam, new_slam

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.slam.frame_preparation import FrameSources
from toolkit.slam.tracking.initial_velocity import initial_velocity
from toolkit.slam.tracking.rolling_shutter import as_exposed, velocity_between

READOUT_S = 0.02


@pytest.fixture(scope="module")
def frames(room: SlamRoom) -> list[Frame]:
    """The frames of the room as a rolling shutter would have exposed them."""
    poses, times = room.truth.T_world_camera, room.truth.timestamps_s
    exposed = []
    for n, frame in enumerate(room.frames):
        a, b = max(n - 1, 0), min(n + 1, len(poses) - 1)
        velocity = velocity_between(poses[a], poses[b], times[b] - times[a])
        rolling = replace(frame, readout_s=READOUT_S)
        rgb, depth_m = as_exposed(frame.rgb, frame.depth_m, rolling, velocity)
        exposed.append(replace(rolling, rgb=rgb, depth_m=depth_m))
    return exposed


def error_m(frames, truth) -> float:
    slam = new_slam(start_velocity=initial_velocity(*frames[:2]))
    fed(slam, frames)
    return absolute_trajectory_error(slam.result().trajectory, truth, "se3").rmse_m


def test_the_path_is_that_of_a_global_shutter(room: SlamRoom, frames):
    bent = error_m([replace(frame, readout_s=0.0) for frame in frames], room.truth)
    straight, clean = error_m(frames, room.truth), error_m(room.frames, room.truth)
    assert straight < 0.75 * bent
    assert straight < 1.2 * clean


def test_the_velocity_at_the_start_is_that_of_the_camera(room: SlamRoom, frames):
    poses, times = room.truth.T_world_camera, room.truth.timestamps_s
    truth = velocity_between(poses[0], poses[1], times[1] - times[0])
    found = initial_velocity(*frames[:2])
    np.testing.assert_allclose(found, truth, atol=0.05 * np.linalg.norm(truth))
    assert initial_velocity(*blind_frames(frames[:2])) is None


def test_a_resumed_run_continues_identically(frames):
    whole, first, second = new_slam(), new_slam(), new_slam()
    fed(whole, frames[:8])
    fed(first, frames[:6])
    second.restore(*first.state())
    fed(second, frames[6:8])
    assert fingerprint(second) == fingerprint(whole)


def test_the_velocity_needs_recent_poses(frames):
    slam = new_slam()
    assert slam.camera_path.velocity(slam.atlas, frames[0]) is None
    fed(slam, frames[:1])
    assert slam.camera_path.velocity(slam.atlas, frames[1]) is None
    fed(slam, frames[1:4])
    poses = slam.result().trajectory.T_world_camera
    mean = velocity_between(poses[0], poses[3], frames[3].timestamp_s - frames[0].timestamp_s)
    np.testing.assert_allclose(slam.camera_path.velocity(slam.atlas, frames[4]), mean, atol=1e-9)
    for late_s in (0.1, 1.0):  # frames were dropped before
        later = replace(frames[4], timestamp_s=frames[4].timestamp_s + late_s)
        assert slam.camera_path.velocity(slam.atlas, later) is None


def test_the_velocity_of_a_located_frame_is_its_own(frames):
    slam = new_slam()
    fed(slam, frames[:4])
    last = slam.result().trajectory.T_world_camera[3]
    step = np.array([0.01, 0.0, 0.02, 0.03, -0.02, 0.01])
    elapsed_s = frames[4].timestamp_s - frames[3].timestamp_s
    known = slam.camera_path.velocity(slam.atlas, frames[4], last @ se3.exp(step))
    np.testing.assert_allclose(known, step / elapsed_s, atol=1e-9)


def test_dropped_and_lost_frames_have_no_velocity(frames):
    slam = new_slam()
    fed(slam, frames[:3])
    known = slam.camera_path.velocity(slam.atlas, frames[3])
    slam.drop_frame(frames[3])  # its pose is that of the frame before
    np.testing.assert_array_equal(slam.camera_path.velocity(slam.atlas, frames[4]), known)
    fed(slam, blind_frames(frames[4:5]))
    assert slam.camera_path.velocity(slam.atlas, frames[5]) is None


def test_what_is_ignored_has_no_depth_in_keyframes(frames):
    """Keyframes are rectified again, by their own velocity, from the frame as it was recorded."""

    class LeftHalf:
        def pixels(self, frame, ignored):
            left = np.zeros_like(ignored)
            left[:, : left.shape[1] // 2] = True
            return ignored | left

    unlabelled = new_slam(sources=FrameSources(ignored=LeftHalf()))
    labelled = new_semantic_slam("recorded", others=LeftHalf())
    for slam in (unlabelled, labelled):
        fed(slam, frames[:6])
        assert len(slam.atlas.keyframes) > 1
        for keyframe in slam.atlas.keyframes:
            half = keyframe.camera.width // 2
            assert not keyframe.depth_m[:, :half].any() and keyframe.depth_m[:, half:].any()
