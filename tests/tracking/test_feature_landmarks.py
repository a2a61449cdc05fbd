"""Features with depth that are followed from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tracked_room import Room, assert_same_place, small_motion

from toolkit.base.geometry import se3
from toolkit.slam.tracking.feature_pose import FeaturePose
from toolkit.slam.tracking.landmarks import Landmarks
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.alignment.levels import finest_level


@pytest.fixture(scope="module")
def levels(room: Room) -> list[FrameLevel]:
    return [finest_level(frame, torch.device("cpu")) for frame in room.frames]


def located(landmarks: Landmarks, level: FrameLevel, start: np.ndarray) -> FeaturePose:
    pose = landmarks.locate(level, [start])
    assert pose is not None
    return pose


def test_frames_are_located_one_after_the_other(room: Room, levels: list[FrameLevel]):
    landmarks = Landmarks(levels[0], room.T_map_camera[0])
    T = room.T_map_camera[0]
    for level, true in zip(levels[1:], room.T_map_camera[1:], strict=True):
        T = located(landmarks, level, T).T_map_camera
        landmarks.extend(level, T)
        assert_same_place(T, true, mm=12.0, deg=0.4)


def test_a_frame_that_is_forgotten_leaves_no_trace(room: Room, levels: list[FrameLevel]):
    start = room.T_map_camera[1]
    once, twice = (Landmarks(levels[0], room.T_map_camera[0]) for _ in range(2))
    expected = located(once, levels[1], start)
    twice.locate(levels[-1], [start])
    twice.undo()
    np.testing.assert_array_equal(
        located(twice, levels[1], start).T_map_camera, expected.T_map_camera
    )


def test_landmarks_move_with_the_frame_of_the_map(room: Room, levels: list[FrameLevel]):
    T_new_old = small_motion(1, metres=2.0, degrees=50.0)
    landmarks = Landmarks(levels[0], room.T_map_camera[0])
    landmarks.change_frame(T_new_old)
    true = T_new_old @ room.T_map_camera[1]
    assert_same_place(located(landmarks, levels[1], true).T_map_camera, true, mm=8.0, deg=0.3)


def test_landmarks_of_a_placed_keyframe_keep_their_place(room: Room, levels: list[FrameLevel]):
    """Only what was found since the last correction was at wrong poses."""
    wrong = small_motion(3, metres=0.1, degrees=5.0)
    landmarks = Landmarks(levels[0], wrong @ room.T_map_camera[0])
    landmarks.correct(se3.inverse(wrong))
    landmarks.correct(wrong)
    true = room.T_map_camera[1]
    assert_same_place(located(landmarks, levels[1], true).T_map_camera, true, mm=8.0, deg=0.3)


def test_features_of_doubtful_frames_tell_nothing_about_the_map(
    room: Room, levels: list[FrameLevel]
):
    start = room.T_map_camera[0]
    certain, doubtful = Landmarks(levels[0], start), Landmarks()
    doubtful.extend(levels[0], start, certain=False)
    one, other = (located(each, levels[1], start) for each in (certain, doubtful))
    np.testing.assert_array_equal(one.T_map_camera, other.T_map_camera)
    assert np.trace(one.information) > 1e4 and not other.information.any()
    restored = Landmarks()
    restored.restore(doubtful.state())
    restored.extend(levels[1], one.T_map_camera)
    found = located(restored, levels[2], one.T_map_camera)
    assert np.trace(found.information) > 1e4, "the features of the certain frame replace them"


def test_restored_landmarks_continue_identically(room: Room, levels: list[FrameLevel]):
    first = Landmarks(levels[0], room.T_map_camera[0])
    first.extend(levels[1], located(first, levels[1], room.T_map_camera[0]).T_map_camera)
    second = Landmarks()
    second.restore(first.state())
    found = [located(one, levels[2], room.T_map_camera[1]) for one in (first, second)]
    np.testing.assert_array_equal(found[0].T_map_camera, found[1].T_map_camera)


def test_without_depth_or_features_there_is_no_pose(room: Room, levels: list[FrameLevel]):
    blind = FrameLevel(levels[0].camera, levels[0].intensity, torch.zeros_like(levels[0].depth_m))
    assert Landmarks(blind, np.eye(4)).locate(levels[1], [np.eye(4)]) is None
    assert Landmarks().locate(levels[1], [np.eye(4)]) is None


def test_the_pose_is_that_of_the_second_start_where_the_first_is_far(
    room: Room, levels: list[FrameLevel]
):
    """A prediction far off, as after a sudden stop."""
    last = room.T_map_camera[0]
    landmarks = Landmarks(levels[0], last)
    wrong = last @ se3.exp(np.array([0.3, 0.2, 0.0, 0.0, 0.2, 0.0]))
    found = landmarks.locate(levels[1], [wrong, last])
    assert found is not None
    assert_same_place(found.T_map_camera, room.T_map_camera[1], mm=8.0, deg=0.3)
