"""Tracking of frames without depth near a given trajectory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracked_room import Room, distance_mm, small_motion

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.slam.tracking.guided import GuidedTracker
from toolkit.slam.tracking.result import Health


def without_depth(frame: Frame) -> Frame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


def guided(room: Room, error: np.ndarray) -> GuidedTracker:
    """A tracker whose trajectory is wrong by a motion of the camera."""
    times = np.array([frame.timestamp_s for frame in room.frames[:2]])
    return GuidedTracker([Trajectory(times, np.array([np.eye(4), room.T_map_camera[1] @ error]))])


def test_the_pose_is_corrected_without_depth(room, gaussians):
    error = small_motion(3, metres=0.03, degrees=0.9)
    tracker = guided(room, error)
    result = tracker.track(without_depth(room.frames[1]), gaussians)
    truth = room.T_map_camera[1]
    assert result.health is Health.GOOD
    assert distance_mm(truth @ error, truth) == pytest.approx(30.0, abs=0.1)
    assert distance_mm(result.T_map_camera, truth) < 6.0
    assert result.renders == 1


def test_frames_with_depth_keep_their_pose(room, gaussians):
    error = small_motion(3, metres=0.01, degrees=0.3)
    darker = replace(room.frames[1], rgb=np.clip(0.8 * room.frames[1].rgb, 0, 1))
    result = guided(room, error).track(darker, gaussians)
    np.testing.assert_array_equal(result.T_map_camera, room.T_map_camera[1] @ error)
    assert result.exposure.gain == pytest.approx(1.25, rel=0.05)


def test_too_large_corrections_are_ignored(room, gaussians):
    error = small_motion(1, metres=0.5, degrees=20.0)
    tracker = guided(room, error)
    result = tracker.track(without_depth(room.frames[1]), gaussians)
    np.testing.assert_array_equal(result.T_map_camera, room.T_map_camera[1] @ error)


def test_an_empty_view_keeps_the_given_pose(room, gaussians):
    turned = se3.exp([0.0, 0.0, 50.0, 0.0, 0.0, 0.0])
    result = guided(room, turned).track(without_depth(room.frames[1]), gaussians)
    assert result.renders == 0
    np.testing.assert_array_equal(result.T_map_camera, room.T_map_camera[1] @ turned)


def test_frames_without_a_pose_are_lost(room, gaussians):
    result = guided(room, np.eye(4)).track(replace(room.frames[1], timestamp_s=99.0), gaussians)
    assert result.lost


def test_the_state_is_restored(room, gaussians):
    darker = replace(room.frames[1], rgb=0.7 * room.frames[1].rgb)
    first = guided(room, np.eye(4))
    first.track(without_depth(darker), gaussians)
    second = guided(room, np.eye(4))
    second.restore(first.state())
    a, b = (tracker.track(without_depth(darker), gaussians) for tracker in (first, second))
    assert a.T_map_camera.tobytes() == b.T_map_camera.tobytes()
    assert a.exposure == b.exposure


def test_a_frame_of_another_part_is_lost_until_the_part_is_entered(room, gaussians):
    first, second = room.frames[:2]
    there = se3.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    parts = [
        Trajectory(np.array([frame.timestamp_s]), pose[None])
        for frame, pose in ((first, np.eye(4)), (second, there))
    ]
    tracker = GuidedTracker(parts)
    assert tracker.first_pose(first) is not None
    assert tracker.pose_in_other_part(first) is None
    assert tracker.track(without_depth(second), gaussians).lost
    np.testing.assert_array_equal(tracker.pose_in_other_part(second), there)
    tracker.enter(second)
    resumed = GuidedTracker(parts)
    resumed.restore(tracker.state())
    for entered in (tracker, resumed):
        assert entered.pose_in_other_part(second) is None
        T = entered.track(second, gaussians).T_map_camera
        np.testing.assert_allclose(T, np.eye(4), atol=1e-12)
        assert entered.track(without_depth(first), gaussians).lost
