"""Surfaces that only a frame between two keyframes shows."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
from painted_box import box_frames
from slam_room import FEW, fed, fingerprint

from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.keyframe import Keyframe
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.boundary import start_next
from toolkit.slam.mapping.intermediate_frames import IntermediateFrames
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import KeyframePolicy
from toolkit.slam.system import Slam
from toolkit.slam.tracking.given import GivenPoses

# Only the first and the last of three frames become keyframes. The fourfold number of iterations is
# taken on such small images.
OPTIONS = replace(FEW, iterations=1, keyframes=KeyframePolicy(interval=2, min_overlap=0.0))


class Turn:
    """A camera in a box that turns about its vertical axis, by given angles in degrees."""

    def __init__(self, *yaws: float) -> None:
        self.T_map_camera = np.array([se3.exp([0, 0, 0, 0, np.radians(a), 0]) for a in yaws])
        self.frames = box_frames(self.T_map_camera, 80, 60)

    def slam(self, fill_holes: bool = True) -> Slam:
        times = np.array([frame.timestamp_s for frame in self.frames])
        tracker = GivenPoses(Trajectory(times, self.T_map_camera))
        return Slam(FrontEnd(tracker), Mapper(replace(OPTIONS, fill_holes=fill_holes)))

    def mapped(self, fill_holes: bool = True) -> Slam:
        slam = self.slam(fill_holes)
        fed(slam, self.frames)
        assert [k.index for k in slam.atlas.keyframes] == [0, 2]
        return slam


def border_error(slam: Slam, turn: Turn) -> float:
    """Mean colour error of the right border of the second frame."""
    frame, T_map_camera = turn.frames[1], turn.T_map_camera[1]
    colour = slam.mapper.render(slam.result().gaussians, frame.camera, T_map_camera).output.colour
    return float(np.abs(colour.numpy() - frame.rgb)[:, -8:].mean())


def test_the_map_contains_the_place_where_the_camera_turned_back():
    turn = Turn(0.0, 10.0, 1.0)
    assert border_error(turn.mapped(fill_holes=False), turn) > 0.3, "the border is black"
    assert border_error(turn.mapped(), turn) < 0.1


def test_frames_on_the_way_to_the_next_keyframe_add_nothing():
    turn = Turn(0.0, 5.0, 10.0)
    first, second = (turn.mapped(fill_holes).atlas.gaussians for fill_holes in (False, True))
    np.testing.assert_array_equal(first.means.numpy(), second.means.numpy())


def test_a_run_resumed_at_the_turning_point_equals_an_uninterrupted_run():
    turn = Turn(0.0, 10.0, 1.0)
    begun, resumed = turn.slam(), turn.slam()
    fed(begun, turn.frames[:2])
    arrays, values = begun.state()
    resumed.restore(arrays, json.loads(json.dumps(values)))
    fed(resumed, turn.frames[2:])
    assert fingerprint(resumed) == fingerprint(turn.mapped())


def intermediate(
    frame: Frame, last: Keyframe, turn: Turn, exposure: Exposure
) -> IntermediateFrames:
    frames = IntermediateFrames()
    frames.add(frame, last, turn.T_map_camera[1], exposure)
    return frames


def test_they_follow_their_keyframe_and_have_the_exposure_of_the_map():
    turn = Turn(0.0, 10.0, 1.0)
    last, newest = (Keyframe.from_frame(turn.frames[n], turn.T_map_camera[n]) for n in (0, 2))
    frames = intermediate(turn.frames[1], last, turn, Exposure(0.5, 0.1))
    correction = se3.exp([0.1, 0.0, 0.2, 0.0, 0.1, 0.0])
    for keyframe in (last, newest):
        keyframe.T_map_camera = correction @ keyframe.T_map_camera
    frames.select(last, newest)
    between = frames.take()
    T_map_camera = last.T_map_camera @ between.T_keyframe_camera
    np.testing.assert_allclose(T_map_camera, correction @ turn.T_map_camera[1], atol=1e-12)
    expected = 0.5 * turn.frames[1].rgb + 0.1
    np.testing.assert_allclose(between.at_map_exposure().rgb, expected, atol=1e-6)
    frames.select(last, newest)
    assert frames.take() is None, "they are used once"


def test_frames_of_another_submap_are_not_used():
    turn = Turn(0.0, 10.0, 1.0)
    last, newest = (Keyframe.from_frame(turn.frames[n], turn.T_map_camera[n]) for n in (0, 2))
    frames = intermediate(turn.frames[1], last, turn, Exposure())
    frames.select(replace(last, index=7), newest)
    assert frames.take() is None


def test_the_end_of_the_sequence_is_mapped():
    turn = Turn(0.0, 10.0)
    slam = turn.slam()
    fed(slam, turn.frames)
    assert [k.index for k in slam.atlas.keyframes] == [0]
    assert border_error(slam, turn) > 0.3, "the border is black"
    slam.finish()
    assert border_error(slam, turn) < 0.1


def test_deferred_frames_are_mapped_one_by_one_or_at_the_end():
    turn = Turn(0.0, 10.0, 1.0)
    slam, waiting = turn.slam(), turn.slam()
    for system in (slam, waiting):
        system.defer_work(OPTIONS.keyframes)
        fed(system, turn.frames)
        assert border_error(system, turn) > 0.3, "the border is black"
    assert slam.map_intermediate_frame()
    assert border_error(slam, turn) < 0.1
    assert not slam.map_intermediate_frame()
    waiting.finish()
    assert border_error(waiting, turn) < 0.1


def test_deferred_frames_of_an_ended_submap_are_not_mapped():
    turn = Turn(0.0, 10.0, 1.0)
    slam = turn.slam()
    slam.defer_work(OPTIONS.keyframes)
    fed(slam, turn.frames)
    start_next(slam.atlas, slam.mapper)
    before = len(slam.atlas.gaussians)
    assert slam.map_intermediate_frame()
    assert len(slam.atlas.gaussians) == before
